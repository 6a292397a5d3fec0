#include "loops/closure_solver.hpp"

#include <algorithm>

namespace ckc {

// As in `ckc_pin.kinematics.sigma`.
constexpr double max_newton_step = 0.5;  // rad, or relative to the mechanism's size; longer steps may change the branch
constexpr double min_fraction = 1e-9;    // of the way to q, in one continuation step
constexpr int max_iterations = 12;
constexpr double min_contraction = 0.1;  // continue to rounding while a step reduces the residual by this factor

ClosureSolver::ClosureSolver(Core& core) : core_(core) {
  q_tree_.setZero(core.tree.nq), base_.setZero(core.tree.nq), step_.setZero(core.n), q_step_.setZero(core.d);
  residual_.setZero(core.constraints.closure.rows), zero_level_.setZero(core.constraints.closure.rows);
}

bool ClosureSolver::project(In q_tree, In w, double tolerance, bool to_rounding) {
  q_tree_ = q_tree;
  double size = 0.0;
  for (int iteration = 0;; ++iteration) {
    if (!q_tree_.allFinite()) return false;
    core_.set_configuration(q_tree_, iteration == expected_steps);
    core_.factorize_phi_z();
    if (!iteration) tolerance *= core_.tolerance_scale();
    residual_ = core_.constraints.phi - w;
    const double previous = size;
    size = residual_size();
    if (iteration && !(size <= std::max(0.5 * previous, tolerance))) return false;
    const bool refine = to_rounding && size > 0.0 && (!iteration || size < min_contraction * previous);
    if (size <= tolerance && (!refine || iteration == max_iterations)) {
      if (expected_steps >= 0) expected_steps = iteration;
      return true;
    }
    if (iteration == max_iterations || !std::isfinite(size) || core_.phi_z.singular()) return false;
    core_.closure_step_in_z(residual_, step_);
    if (!(step_.cwiseQuotient(core_.scales.columns).lpNorm<Eigen::Infinity>() <= max_newton_step)) return false;
    core_.tree.integrate(q_tree_, step_);
    ++newton_steps;
  }
}

bool ClosureSolver::continue_to(In q, double tolerance) {
  base_ = core_.q_tree;
  for (int k = 0; k < core_.d; ++k) q_step_(k) = q(k) - base_(core_.tree.q_index[core_.q[k]]);
  const bool has_negative_determinant = core_.has_negative_determinant();
  double fraction = 0.0, next_fraction = 1.0;
  while (fraction < 1.0 && next_fraction >= min_fraction) {
    const double remaining = 1.0 - fraction, step_fraction = std::min(next_fraction, remaining);
    core_.compute_rho();
    core_.multiply_rho(step_fraction * q_step_, step_);
    q_tree_ = base_;
    core_.tree.integrate(q_tree_, step_);
    const bool succeeded =
        project(q_tree_, zero_level_, tolerance) && core_.has_negative_determinant() == has_negative_determinant;
    if (succeeded) {
      base_ = core_.q_tree;
      fraction = step_fraction == remaining ? 1.0 : fraction + step_fraction;
    } else {
      core_.set_configuration(base_), core_.factorize_phi_z();
    }
    next_fraction = step_fraction * (succeeded ? 2.0 : 0.5);
  }
  return fraction == 1.0 && !core_.phi_z.singular();
}

// Redundant rows may contradict each other slightly. Measure only the part of the residual that z can correct.
double ClosureSolver::residual_size() {
  if (!residual_.allFinite()) return std::nan("");
  const auto z_count = static_cast<Eigen::Index>(core_.z.size());
  if (residual_.size() > z_count && !core_.phi_z.singular()) {
    z_.resize(z_count);
    core_.solve_z(residual_, z_);
    residual_.setZero();
    for (Eigen::Index k = 0; k < z_count; ++k) residual_ += z_(k) * core_.constraints.J().col(core_.z[k]);
  }
  return residual_.size() ? residual_.lpNorm<Eigen::Infinity>() : 0.0;
}

}  // namespace ckc
