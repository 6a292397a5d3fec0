#include "motion/dae.hpp"

#include <algorithm>

#include "loops/compiled_terms.hpp"

namespace ckc {

constexpr double max_z_step_ratio = 4.0;   // of a step of z alone to a minimum-norm step: large near a singular phi_z
constexpr double newton_tolerance = 1e-9;  // rad, or relative to the mechanism's size

static double largest_entry(In x) { return x.size() ? x.lpNorm<Eigen::Infinity>() : 0.0; }

Dae::Dae(Core& core_, Control& control_, double tolerance, bool projects, double alpha, double beta)
    : System(core_, control_, core_.tree.nq + core_.n),
      tolerance_(tolerance),
      alpha_(alpha),
      beta_(beta),
      projects_(projects) {
  crosses_singularities = projects;
  q_tree_.setZero(core.tree.nq), step_.setZero(core.n), z_step_.setZero(core.n), no_force_.setZero(core.n),
      residual_.setZero(core.constraints.closure.rows), phi_dot_.setZero(core.constraints.closure.rows);
}

void Dae::start(double, In q_tree, In v, In, Out y) {
  elimination.reset(core);
  y.head(core.tree.nq) = q_tree, y.segment(core.tree.nq, core.n) = v;
}

void Dae::set_core(In q_tree, bool with_inertia) {
  core.set_configuration(q_tree, with_inertia);
  core.compute_J();
  core_configuration_ = with_inertia ? core.configuration_count : -1, core_row_version_ = row_version();
}

bool Dae::is_core_at_state() const {
  return core_configuration_ == core.configuration_count && core_row_version_ == row_version() && q_tree_ == core.q_tree;
}

// Does nothing if the core is already at this configuration.
bool Dae::set_core_configuration(In y) {
  q_tree_ = y.head(core.tree.nq);
  if (!q_tree_.allFinite()) return false;
  // Compare before normalizing, which could change the last digit again.
  if (is_core_at_state()) return true;
  core.tree.normalize(q_tree_);
  if (!is_core_at_state()) set_core(q_tree_);
  return true;
}

bool Dae::needs_core() const {
  return !core.compiled || !core.joints.locked.empty() || force_needs_core() || is_stabilized() ||
         core.has_released_rows();
}

const CompiledTerms* Dae::terms_of_rate() const {
  const bool is_whole = size == motion_size && core.tree.roots.empty() && prescribed_joints().empty();
  return is_whole && !needs_core() && core.compiled->has_accelerations() ? core.compiled.get() : nullptr;
}

bool Dae::force_of_rate(double t, In q_tree, In v, Out force) {
  force.setZero();
  if (!has_applied_force()) return true;
  if (!compute_forces(t, q_tree, v)) return false;
  force = applied_force(v);
  return true;
}

bool Dae::motion_rhs(double t, In y, Out y_dot) {
  if (!finite(y)) return fail(RhsFailure::not_finite);
  const auto v = y.tail(core.n);
  v_tree = v;
  // Compiled terms give the acceleration without setting the core.
  if (!needs_core()) {
    q_tree_ = y.head(core.tree.nq);
    core.tree.normalize(q_tree_);
    const bool has_force = has_applied_force();
    if (has_force && !compute_forces(t, q_tree_, v)) return false;
    if (core.compiled_acceleration(q_tree_, v, has_force ? applied_force(v) : no_force_, row_correction_,
                                   y_dot.tail(core.n))) {
      counts.factorizations += 2;
      core.tree.configuration_rate(q_tree_, v, y_dot.head(core.tree.nq));
      return finite(y_dot) || fail(RhsFailure::not_finite);
    }
    ++counts.general_rhs;
  } else if (core.compiled && !core.compiled->allows_elimination()) {
    ++counts.general_rhs;
  }
  set_core_configuration(y);
  return evaluate_rate(t, v, y_dot);
}

bool Dae::compute_forces(double t, In q_tree, In v) {
  set_q_and_q_dot(q_tree, v);
  v_tree = v;
  return compute_control(t);
}

void Dae::set_q_and_q_dot(In q_tree, In v) {
  for (int k = 0; k < core.d; ++k) q(k) = q_tree(core.tree.q_index[core.q[k]]), q_dot(k) = v(core.q[k]);
}

bool Dae::evaluate_rate(double t, In v, Out y_dot) {
  const int n = core.n;
  core.set_velocity(v);
  if (!compute_forces(t, core.q_tree, v)) return false;
  residual_ = row_correction_;
  if (is_stabilized()) add_stabilization(core.v_tree);
  counts.factorizations += 2;
  core.tree.configuration_rate(core.q_tree, v, y_dot.head(core.tree.nq));
  if (!acceleration_with_held_joints(v, residual_, y_dot.tail(n))) return false;
  return finite(y_dot) || fail(RhsFailure::not_finite);
}

// Baumgarte's terms 2 alpha phi_dot + beta^2 phi, into residual_.
void Dae::add_stabilization(In v) {
  core.constraints.multiply_J(v, phi_dot_);
  if (core.has_row_motion()) phi_dot_ -= core.row_motion.rate;
  residual_ += 2 * alpha_ * phi_dot_ + beta_ * beta_ * core.constraints.phi;
}

// phi_dot at velocity v, into residual_.
void Dae::set_rate_residual(In v) {
  core.constraints.multiply_J(v, residual_);
  if (core.has_row_motion()) residual_ -= core.row_motion.rate;
}

// Derivatives with respect to the entries of q'. The rotation of a quaternion is that of its normalized value.
bool Dae::motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  const int n = core.n, nq = core.tree.nq;
  if (!finite(y)) return false;
  q_tree_ = y.head(nq);
  core.tree.normalize(q_tree_);
  const auto v = y.tail(n);
  if (!core.compiled || !core.joints.locked.empty() || force_needs_core() || is_stabilized() ||
      core.has_row_motion())
    set_core_configuration(y), core.set_velocity(v);
  if (!compute_forces(t, q_tree_, v)) return false;
  residual_ = row_correction_;
  if (is_stabilized()) add_stabilization(v);
  if (!acceleration_derivatives(q_tree_, v, residual_)) return System::motion_jacobian(t, y, jacobian, evaluations);
  if (is_stabilized() && core.constraints.closure.rows) {
    DynamicsDerivatives& by = core.derivatives;
    by.compute(q_tree_, v, eq_1_.a, row_correction_);  // of the constraint rows, which compiled terms do not compute
    const Matrix none = Matrix::Zero(n, n);
    if (!core.solve_acceleration_derivatives(none, 2 * alpha_ * by.rate_by_q + beta_ * beta_ * by.J, stabilization_))
      return false;
    eq_1_.by_q += stabilization_;
    if (!core.solve_acceleration_derivatives(none, 2 * alpha_ * by.J, stabilization_)) return false;
    eq_1_.by_v += stabilization_;
  }
  jacobian.setZero(nq + n, nq + n);
  for (int k : core.tree.single_dof) jacobian(core.tree.q_index[k], nq + k) = 1.0;
  for (const Tree::Root& root : core.tree.roots)
    for (int k = root.v; k < root.v + 6; ++k)
      core.tree.configuration_rate(q_tree_, Vector::Unit(n, k), jacobian.col(nq + k).head(nq));
  jacobian.bottomRightCorner(n, n) = eq_1_.by_v;
  if (nq == n) {
    jacobian.bottomLeftCorner(n, n) = eq_1_.by_q;
  } else {
    const Matrix tangents = core.tree.q_dot_to_tangent(y.head(nq));
    jacobian.topLeftCorner(nq, nq) = core.tree.configuration_rate_derivative(q_tree_, v) * tangents;
    jacobian.bottomLeftCorner(n, nq) = eq_1_.by_q * tangents;
  }
  return finite(jacobian.reshaped());
}

// A stiff controller would respond to a correction of the measured q. With a controller, only z is corrected, unless
// that takes much longer steps.
bool Dae::closure_step(In residual) {
  if (!core.closure_step(residual, step_)) return false;
  if (!control.is_active()) return true;
  core.factorize_phi_z();
  if (core.phi_z.singular()) return true;
  core.closure_step_in_z(residual, z_step_);
  const Vector& units = core.scales.columns;
  if (z_step_.cwiseQuotient(units).norm() < max_z_step_ratio * step_.cwiseQuotient(units).norm()) step_ = z_step_;
  return true;
}

bool Dae::project_onto_manifold(In y) {
  set_core_configuration(y);
  const double tolerance = tolerance_ * core.tolerance_scale();
  for (int k = 0; largest_entry(core.constraints.phi) > tolerance; ++k) {
    if (k == max_newton_steps || !core.constraints.phi.allFinite() || !closure_step(core.constraints.phi)) return false;
    ++counts.newton, counts.factorizations += 2;
    core.constraints.multiply_J(step_, residual_);
    core.tree.integrate(q_tree_, step_);
    set_core(q_tree_);
    if (largest_entry(residual_) <= tolerance) break;  // redundant rows that contradict each other keep phi large
  }
  velocity = velocity_in(y);
  set_rate_residual(velocity);
  if (largest_entry(residual_) <= rate_rounding * core.constraints.J_norm() * velocity.norm()) return true;
  if (!closure_step(residual_)) return false;
  velocity += step_;
  return velocity.allFinite();
}

bool Dae::rate_on_manifold(double t, In y, Out y_dot) {
  if (!set_time(t) || !finite(y.head(motion_size))) return false;
  q_tree_ = y.head(core.tree.nq);
  core.tree.normalize(q_tree_);
  set_core(q_tree_, false);
  for (int k = 0;; ++k) {
    if (k == max_newton_steps || !core.cheapest_closure_step(core.constraints.phi, step_)) return false;
    ++counts.factorizations;
    core.tree.integrate(q_tree_, step_);
    set_core(q_tree_);
    // Newton's method converges quadratically: the remaining error is the square of this step.
    if (largest_entry(step_.cwiseQuotient(core.scales.columns)) <= newton_tolerance) break;
  }
  set_rate_residual(velocity_in(y));
  if (!core.cheapest_closure_step(residual_, step_)) return false;
  ++counts.factorizations;
  velocity = velocity_in(y) + step_;
  return evaluate_rate(t, velocity, y_dot);
}

void Dae::rate_pairs(std::vector<std::pair<int, int>>& of) const {
  of.clear();
  for (int k : core.tree.single_dof) of.emplace_back(core.tree.q_index[k], core.tree.nq + k);
}

// Restrict the Jacobian to the tangent space. Its other eigenvalues belong to motions off the constraint manifold,
// which do not occur.
bool Dae::reduce_to_freedoms(In y, Matrix& jacobian) {
  const int n = core.n, nq = core.tree.nq, d = n - core.rank;
  set_core_configuration(y);
  const Matrix* tangent = core.compute_tangent_basis();
  if (!tangent) return false;
  Matrix q_rates(nq, d), freedoms = Matrix::Zero(2 * d, 2 * d);
  for (int k = 0; k < d; ++k) core.tree.configuration_rate(q_tree_, tangent->col(k), q_rates.col(k));
  const auto gram = (tangent->transpose() * *tangent).ldlt();
  freedoms.topRightCorner(d, d).setIdentity();
  freedoms.bottomLeftCorner(d, d) = gram.solve(tangent->transpose() * (jacobian.bottomLeftCorner(n, nq) * q_rates));
  freedoms.bottomRightCorner(d, d) = gram.solve(tangent->transpose() * (jacobian.bottomRightCorner(n, n) * *tangent));
  jacobian = freedoms;
  return true;
}

bool Dae::sync_motion(double t, In y) {
  if (!set_time(t)) return false;
  if (projects_) {
    if (!project_onto_manifold(y)) return false;
  } else {
    set_core_configuration(y);
    velocity = velocity_in(y);
  }
  v_tree = velocity;
  set_q_and_q_dot(core.q_tree, velocity);
  return true;
}

bool Dae::sync_core_at_start(double t, In y) {
  if (!sync_core(t, y)) return false;
  elimination.check_start(core, v_tree);
  return true;
}

void Dae::move_core_to_last_rhs(In y) {
  set_core_configuration(y);
  velocity = v_tree = velocity_in(y);
}

bool Dae::sync_motion_at_last_rhs(double t, In y) {
  if (!set_time(t)) return false;
  set_core_configuration(y);
  velocity = v_tree = velocity_in(y);
  if (elimination.is_due()) elimination.remember_state(core.q_tree, v_tree, applied_force(v_tree));
  return true;
}

bool Dae::sync_motion_unprojected(double t, In y) {
  if (!set_time(t) || !set_core_configuration(y)) return false;
  velocity = v_tree = velocity_in(y);
  set_q_and_q_dot(core.q_tree, velocity);
  return true;
}

bool Dae::read_from_state(In y, int k, bool of_rate, double& value) const {
  const int nq = core.tree.nq;
  if (!of_rate && nq != core.n && !std::binary_search(core.tree.single_dof.begin(), core.tree.single_dof.end(), k))
    return false;
  return value = y(of_rate ? nq + k : core.tree.q_index[k]), true;
}

void Dae::write_projected_state(Out y) const {
  if (projects_) y.head(core.tree.nq) = core.q_tree, y.segment(core.tree.nq, core.n) = velocity;
}

Accepted Dae::accept_motion(double t, Out y, double) {
  if (!set_time(t)) return Accepted::rejected;
  elimination.accept_step(core);
  if (!projects_) return Accepted::unchanged;
  set_core_configuration(y);
  set_rate_residual(velocity_in(y));
  const double drift_rate = largest_entry(residual_) / (1.0 + largest_entry(velocity_in(y)));
  if (std::max(largest_entry(core.constraints.phi), drift_rate) <= tolerance_ * core.tolerance_scale())
    return Accepted::unchanged;
  if (!project_onto_manifold(y)) return Accepted::rejected;
  write_projected_state(y);
  return Accepted::changed;
}

}  // namespace ckc
