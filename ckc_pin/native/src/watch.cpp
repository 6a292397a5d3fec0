#include "watch.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

// As in `simulation.rank_guard`, except for `near`: below that a step's end is Python's, by singular values, not their
// squares.
constexpr double deep = 0.7, neck = 0.2, jump = 0.7, steps_ahead = 4.0, shortest = 1e-6, near = 1e-4;

Watch::Watch(const Core& core, In row_scale, In column_scale)
    : row_scale_(row_scale),
      column_scale_(column_scale),
      eigen_(std::max(core.rows.closure.rows, 1)),
      chart_eigen_(std::max<int>(core.z.size(), 1)) {
  const int m = core.rows.closure.rows, k = static_cast<int>(core.z.size());
  scaled_.setZero(m, core.n), gram_.setZero(m, m), u_.setZero(m), v_.setZero(core.n);
  shifted_.shape(m, m, full_pattern(m));
  phi_z_.setZero(m, k), phi_z_gram_.setZero(k, k);
  // Solvers cannot be copied before their first use.
  eigen_.compute(Matrix::Identity(std::max(m, 1), std::max(m, 1)), Eigen::EigenvaluesOnly);
  chart_eigen_.compute(Matrix::Identity(std::max(k, 1), std::max(k, 1)), Eigen::EigenvaluesOnly);
}

void Watch::decompose(const Core& core) {
  scaled_ = core.rows.J;
  scaled_.array().colwise() *= row_scale_.array();
  scaled_.array().rowwise() *= column_scale_.transpose().array();
  gram_.noalias() = scaled_ * scaled_.transpose();
  eigen_.compute(gram_, Eigen::EigenvaluesOnly);
}

double Watch::at(const Core& core) {
  decompose(core);
  const auto m = gram_.rows();
  return std::sqrt(std::max(eigen_.eigenvalues()(m - core.rank), 0.0) / eigen_.eigenvalues()(m - 1));
}

Watch::Rank Watch::rank(System& system) {
  Core& core = system.core;
  if (core.rank == 0) return {1.0, 0.0};
  decompose(core);
  const auto m = gram_.rows();
  const double largest = std::sqrt(eigen_.eigenvalues()(m - 1));
  direction(eigen_.eigenvalues()(m - core.rank));
  v_.noalias() = scaled_.transpose() * u_;
  const double least = v_.norm();  // to rounding, of which its square's eigenvalue has half the digits
  core.rates(system.velocity);
  core.rows.jacobian_dot(core.tree, core.tree.jacobian_rate(core.q_tree, system.velocity));
  v_.array() *= column_scale_.array();
  u_.array() *= row_scale_.array();
  double rate = 0.0;
  for (int i = 0; i < m; ++i)
    for (int j : core.rows.pattern[i]) rate += u_(i) * core.rows.J_dot(i, j) * v_(j);
  return {least / largest, rate / std::max(least, 1e-300) / largest};
}

void Watch::direction(double value) {
  gram_.diagonal().array() -= value + 1e-12 * eigen_.eigenvalues()(gram_.rows() - 1);
  shifted_.compute(gram_);
  for (Eigen::Index k = 0; k < u_.size(); ++k) u_(k) = 1.0 + 0.1 * static_cast<double>(k % 7);  // along nothing
  for (int k = 0; k < 2; ++k) {  // inverse iteration: the shift is as good as the value
    shifted_.solve(u_, u_);
    u_.normalize();
  }
}

bool Watch::chart(const Core& core) {
  if (core.z.empty()) return true;
  for (size_t j = 0; j < core.z.size(); ++j) phi_z_.col(j) = core.rows.J.col(core.z[j]);
  phi_z_gram_.noalias() = phi_z_.transpose() * phi_z_;
  chart_eigen_.compute(phi_z_gram_, Eigen::EigenvaluesOnly);
  const double least = chart_eigen_.eigenvalues()(0);
  return least > chart_margin * chart_margin * core.rows.J.squaredNorm();
}

bool Watch::ahead(const Rank& end, double length) const {
  return end.rate < 0.0 && end.value <= -steps_ahead * length * end.rate;
}

bool Watch::plain(const Rank& at) const { return at.value > near && std::isfinite(at.rate); }

double Watch::part(const Rank& before, const Rank& after, double h) const {
  if (!plain(after)) return 0.0;
  if (before.rate < 0.0 && after.rate > 0.0) {  // a V: where the tangents at both ends meet
    const double place = (after.value - before.value - after.rate * h) / (before.rate - after.rate);
    return before.value + before.rate * place < deep * std::max(before.value, after.value) ? 0.0 : 1.0;
  }
  // falling, zero, a peak, and falling again; or a peak, zero, and rising again
  const bool over = before.rate < 0.0 ? h > jump * before.value / -before.rate
                                      : after.rate > 0.0 && h * after.rate > after.value;
  if (!over) return 1.0;
  return h > shortest ? 0.5 : 0.0;
}

double Watch::part(const Rank& before, const Rank& after, double h, double least) const {
  if (!plain(after)) return 0.0;
  if (least >= neck * std::max(before.value, after.value)) return 1.0;
  return h > shortest ? 0.25 : 0.0;
}

}  // namespace ckc
