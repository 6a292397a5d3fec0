#include "loops/closure_solver.hpp"

#include <algorithm>

namespace ckc {

// Those of `ckc_pin.kinematics.sigma`.
constexpr double max_step = 0.5;  // rad, or of the mechanism's size: a longer Newton step in one coordinate is not local
constexpr double smallest_piece = 1e-9;
constexpr int max_iterations = 12;
constexpr double gains = 0.1;  // Newton's method to rounding goes on while a step leaves no more

Closing::Closing(Core& core) : core_(core) {
  q_tree_.setZero(core.tree.nq), at_.setZero(core.tree.nq), step_.setZero(core.n), dq_.setZero(core.d);
  residual_.setZero(core.rows.closure.rows), none_.setZero(core.rows.closure.rows);
}

bool Closing::close(In q_tree, In w, double tolerance, bool to_rounding) {
  q_tree_ = q_tree;
  double size = 0.0;
  for (int iteration = 0;; ++iteration) {
    if (!q_tree_.allFinite()) return false;
    core_.set(q_tree_, iteration == expected);
    core_.factor();
    if (!iteration) tolerance *= core_.coarseness();
    residual_ = core_.rows.phi - w;
    const double previous = size;
    size = unclosed();
    if (iteration && !(size <= std::max(0.5 * previous, tolerance))) return false;
    const bool polish = to_rounding && size > 0.0 && (!iteration || size < gains * previous);
    if (size <= tolerance && (!polish || iteration == max_iterations)) {
      if (expected >= 0) expected = iteration;
      return true;
    }
    if (iteration == max_iterations || !std::isfinite(size) || core_.phi_z.singular()) return false;
    core_.z_step(residual_, step_);
    if (!(step_.cwiseQuotient(core_.scales.columns).lpNorm<Eigen::Infinity>() <= max_step)) return false;
    core_.tree.integrate(q_tree_, step_);
    ++corrections;
  }
}

bool Closing::move(In q, double tolerance) {
  at_ = core_.q_tree;
  for (int k = 0; k < core_.d; ++k) dq_(k) = q(k) - at_(core_.tree.place[core_.q[k]]);
  const bool reversed = core_.reversed();
  double done = 0.0, piece = 1.0;
  while (done < 1.0 && piece >= smallest_piece) {
    const double left = 1.0 - done, part = std::min(piece, left);
    core_.reduce();
    core_.velocity(part * dq_, step_);
    q_tree_ = at_;
    core_.tree.integrate(q_tree_, step_);
    const bool good = close(q_tree_, none_, tolerance) && core_.reversed() == reversed;
    if (good) {
      at_ = core_.q_tree;
      done = part == left ? 1.0 : done + part;
    } else {
      core_.set(at_), core_.factor();
    }
    piece = part * (good ? 2.0 : 0.5);
  }
  return done == 1.0 && !core_.phi_z.singular();
}

// Redundant rows may contradict each other slightly.
double Closing::unclosed() {
  if (!residual_.allFinite()) return std::nan("");
  const auto dependent = static_cast<Eigen::Index>(core_.z.size());
  if (residual_.size() > dependent && !core_.phi_z.singular()) {
    z_.resize(dependent);
    core_.solve_z(residual_, z_);
    residual_.setZero();
    for (Eigen::Index k = 0; k < dependent; ++k) residual_ += z_(k) * core_.rows.J.col(core_.z[k]);
  }
  return residual_.size() ? residual_.lpNorm<Eigen::Infinity>() : 0.0;
}

}  // namespace ckc
