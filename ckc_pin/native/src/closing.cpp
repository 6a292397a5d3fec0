#include "closing.hpp"

#include <algorithm>

namespace ckc {

// Those of `ckc_pin.kinematics.sigma`.
constexpr double max_step = 0.5, smallest_piece = 1e-9;
constexpr int max_iterations = 12;

Closing::Closing(Core& core, Vector reach, double tolerance)
    : core_(core), reach_(std::move(reach)), tolerance_(tolerance) {
  q_tree_.setZero(core.tree.nq), at_.setZero(core.tree.nq), step_.setZero(core.n), dq_.setZero(core.d);
  residual_.setZero(core.rows.closure.rows), z_.setZero(core.z.size());
}

bool Closing::close(In q_tree) {
  q_tree_ = q_tree;
  return newton();
}

bool Closing::move(In q) {
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
    const bool good = newton() && core_.reversed() == reversed;
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

bool Closing::newton() {
  double size = 0.0;
  for (int iteration = 0;; ++iteration) {
    core_.set(q_tree_);
    core_.factor();
    residual_ = core_.rows.phi;
    const double previous = size;
    size = unclosed();
    if (iteration && !(size <= std::max(0.5 * previous, tolerance_))) return false;
    if (size <= tolerance_) return true;
    if (iteration == max_iterations || !std::isfinite(size) || core_.phi_z.singular()) return false;
    core_.z_step(residual_, step_);
    if (!(step_.cwiseQuotient(reach_).lpNorm<Eigen::Infinity>() <= max_step)) return false;
    core_.tree.integrate(q_tree_, step_);
  }
}

// The largest part of the residual that z could still close.
double Closing::unclosed() {
  if (!residual_.allFinite()) return std::nan("");
  if (residual_.size() > z_.size() && !core_.phi_z.singular()) {
    core_.solve_z(residual_, z_);
    residual_.setZero();
    for (Eigen::Index k = 0; k < z_.size(); ++k) residual_ += z_(k) * core_.rows.J.col(core_.z[k]);
  }
  return residual_.size() ? residual_.lpNorm<Eigen::Infinity>() : 0.0;
}

}  // namespace ckc
