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
      spectrum_(core.rows.pattern, core.n, core.rank),
      chart_eigen_(std::max<int>(static_cast<int>(core.z.size()), 1)) {
  const int m = core.rows.closure.rows, k = static_cast<int>(core.z.size());
  u_.setZero(m), v_.setZero(core.n);
  phi_z_.setZero(m, k), phi_z_gram_.setZero(k, k);
  // A solver cannot be copied before its first use.
  chart_eigen_.compute(Matrix::Identity(std::max(k, 1), std::max(k, 1)), Eigen::EigenvaluesOnly);
}

double Watch::at(const Core& core) {
  spectrum_.compute(core.rows.J, row_scale_, column_scale_);
  return spectrum_.least() / spectrum_.largest();
}

Watch::Rank Watch::rank(System& system) {
  Core& core = system.core;
  if (core.rank == 0) return {1.0, 0.0};
  spectrum_.compute(core.rows.J, row_scale_, column_scale_);
  spectrum_.vectors(u_, v_);
  const double least = v_.norm(), largest = spectrum_.largest();
  core.rates(system.velocity);
  core.rows.jacobian_dot(core.tree, core.tree.jacobian_rate(core.q_tree, system.velocity));
  v_.array() *= column_scale_.array();
  u_.array() *= row_scale_.array();
  double rate = 0.0;
  for (Eigen::Index i = 0; i < u_.size(); ++i)
    for (int j : core.rows.pattern[i]) rate += u_(i) * core.rows.J_dot(i, j) * v_(j);
  return {least / largest, rate / std::max(least, 1e-300) / largest};
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
