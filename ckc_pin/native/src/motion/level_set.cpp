#include "motion/level_set.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ckc {

// Margins are the smallest singular value of phi_z over |J|.
constexpr double partition_search_margin = 0.03;  // below it a better q is searched for
constexpr double search_again_ratio = 0.7;        // next search at this fraction of the margin of a search in vain
constexpr double min_margin = 1e-3;               // below it, search at every step
constexpr double min_margin_gain = 2.0;           // a better q has to increase the margin by this factor
// Weight of a disagreement in steps of the usual size, and the balance at which the run is given up.
constexpr double rejection_weight = 3.0, max_rejection_balance = 100.0;
constexpr double rounding = 8 * std::numeric_limits<double>::epsilon();
constexpr double w_lifetime = 100.0;  // in epsilon: later w is set to zero

LevelSet::LevelSet(Core& core_, Control& control_, double epsilon, bool actual, double tolerance, double rhs_tolerance)
    : System(core_, control_, 2 * core_.d),
      epsilon_(epsilon),
      tolerance_(tolerance),
      rhs_tolerance_(rhs_tolerance),
      actual_(actual),
      fixed_partition_{core.q, core.z},
      search_margin_(partition_search_margin),
      predictor_(core, epsilon),
      closure_solver_(core) {
  const int m = core.constraints.closure.rows;
  q_tree_.setZero(core.tree.nq), step_.setZero(core.n), residual_.setZero(m), a_tree_.setZero(core.n), w0_.setZero(m),
      z_.setZero(core.z.size());
}

void LevelSet::start(double t, In q_tree, In v, In w_start, Out y) {
  if (core.q != fixed_partition_.q) core.set_partition(fixed_partition_.q, fixed_partition_.z);
  disagreements_ = 0, rejection_balance_ = 0.0, closure_solver_.expected_steps = 0;
  elimination.reset(core);
  t_start_ = accepted_t_ = t, w0_ = w_start, on_manifold_ = w0_.isZero(0);
  core.set_configuration(q_tree);
  core.compute_rho();
  reset_coordinates(q_tree);
  write_chart_coordinates(y);
  for (int k = 0; k < core.d; ++k) y(core.d + k) = v(core.q[k]);
}

void LevelSet::reset_coordinates(In q_tree) {
  chart_.reset(core, q_tree);
  predictor_.reset(core, q_tree, !on_manifold_);
  accepted_q_tree_ = last_q_tree_ = q_tree;
  search_margin_ = partition_search_margin;
  partition_changed();
}

void LevelSet::write_chart_coordinates(Out y) { chart_.coordinates(core, core.q_tree, y.head(core.d)); }

void LevelSet::update_w(double t) {
  if (on_manifold_)
    w.setZero();
  else
    w = w0_ * std::exp(-(t - t_start_) / epsilon_);
}

bool LevelSet::project_state(double t, In y, double tolerance) {
  const int d = core.d;
  if (!set_time(t)) return false;
  update_w(t);
  predictor_.predict(t, y.head(d), chart_, core, w, q_tree_);
  if (!project_from_predicted(tolerance)) {
    predict_from_accepted();
    predictor_.predict(t, y.head(d), chart_, core, w, q_tree_);
    if (!project_from_predicted(tolerance)) return false;
  }
  if (chart_.is_trivial())
    q = y.head(d);
  else
    for (int k = 0; k < d; ++k) q(k) = core.q_tree(core.tree.q_index[core.q[k]]);
  core.compute_rho();
  q_dot = y.segment(d, d);
  core.multiply_rho(q_dot, v_tree);
  if (core.has_row_motion()) {  // v' = rho q_dot + what makes the rows follow their motion
    core.solve_z(core.row_motion.rate, z_);
    for (size_t k = 0; k < core.z.size(); ++k) v_tree(core.z[k]) += z_(k);
  }
  velocity = v_tree;
  if (!on_manifold_) {
    core.solve_z(w, z_);
    for (size_t k = 0; k < core.z.size(); ++k) velocity(core.z[k]) -= z_(k) / epsilon_;
    if (actual_) v_tree = velocity;
  }
  predictor_.add(t, core, core.q_tree, velocity, w);
  return true;
}

bool LevelSet::sync_core_at_start(double t, In y) {
  if (!sync_core(t, y)) return false;
  last_q_tree_ = core.q_tree;
  elimination.check_start(core, v_tree);
  return true;
}

// Near a singular phi_z the state must be projected exactly, or later states cannot be.
bool LevelSet::sync_motion_at_last_rhs(double t, In y) {
  if (coordinate_margin() < min_margin && !sync_core(t, y)) return false;
  last_q_tree_ = core.q_tree;
  if (elimination.is_due()) elimination.remember_state(core.q_tree, v_tree, applied_force(v_tree));
  return true;
}

bool LevelSet::read_from_state(In y, int k, bool of_rate, double& value) const {
  const auto at = std::find(core.q.begin(), core.q.end(), k);
  if (at == core.q.end() || !(of_rate || chart_.is_trivial())) return false;
  return value = y((of_rate ? core.d : 0) + (at - core.q.begin())), true;
}

bool LevelSet::project_from_predicted(double tolerance) {
  closure_solver_.newton_steps = 0;
  const bool closed = closure_solver_.project(q_tree_, w, tolerance, project_to_rounding_ || disagreements_ > 1);
  counts.newton += closure_solver_.newton_steps, counts.factorizations += closure_solver_.newton_steps;
  return closed;
}

bool LevelSet::motion_rhs(double t, In y, Out y_dot) {
  const int d = core.d;
  if (!finite(y)) return fail(RhsFailure::not_finite);
  if (!project_state(t, y, disagreements_ || project_to_rounding_ ? tolerance_ : std::max(tolerance_, rhs_tolerance_)))
    return fail(RhsFailure::loops_open);
  core.set_velocity(v_tree);
  if (!compute_control(t)) return false;
  counts.factorizations += 2;  // phi_z and D
  if (chart_.is_trivial())
    y_dot.head(d) = q_dot;
  else
    chart_.coordinate_rates(core, core.q_tree, q_dot, y_dot.head(d));
  // On the manifold eq. 6 equals eq. 1 at rho q_dot.
  const Vector& force = applied_force(v_tree);
  const bool locked = !core.joints.locked.empty();
  // With D of a controller, eq. 6 costs less than sparse elimination.
  const bool eliminates = on_manifold_ && (core.compiled || (core.has_elimination() && !core.is_D_computed())) &&
                          !locked && !core.has_released_rows();
  has_tree_acceleration_ = eliminates && core.eliminate(force, row_correction_, a_tree_);
  if (eliminates && core.compiled && !has_tree_acceleration_) ++counts.general_rhs;
  if (!has_tree_acceleration_ && (locked || core.has_row_motion() || (on_manifold_ && core.uses_mass_levels()))) {
    if (!acceleration_with_held_joints(v_tree, row_correction_, a_tree_)) return false;
    has_tree_acceleration_ = true;
  }
  if (has_tree_acceleration_)
    for (int k = 0; k < d; ++k) y_dot(d + k) = a_tree_(core.q[k]);
  else if (actual_ && !on_manifold_)
    core.actual_acceleration(force, q_dot, y_dot.tail(d));
  else
    core.reduced_acceleration(force, y_dot.tail(d));
  return finite(y_dot) || fail(RhsFailure::not_finite);
}

bool LevelSet::motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  if ((on_manifold_ || !actual_) && exact_jacobian(t, y, jacobian)) return true;
  project_exactly(true);
  const bool exists = System::motion_jacobian(t, y, jacobian, evaluations);
  project_exactly(false);
  return exists;
}

// Derivative of eq. 1 at q'(q) and v'(q, q_dot): dq'/dq = rho, dv'/dq_dot = rho, and dv'/dq = rho_dot at velocity v'
// (plus a bracket term for free roots).
bool LevelSet::exact_jacobian(double t, In y, Matrix& jacobian) {
  const int d = core.d, n = core.n;
  if (!finite(y) || !project_state(t, y, tolerance_)) return false;
  core.set_velocity(v_tree);
  if (!compute_control(t) || !acceleration_derivatives(core.q_tree, v_tree, row_correction_)) return false;
  core.compute_J_dot(v_tree);
  rho_dot_.resize(n, d);
  for (int k = 0; k < d; ++k) {
    unit_q_dot_.setUnit(d, k);
    core.multiply_rho_dot(unit_q_dot_, rho_dot_.col(k));
  }
  if (!core.tree.roots.empty()) {
    const Matrix rotated = core.tree.bracket_matrix(v_tree) * core.rho;
    for (int k = 0; k < d; ++k) {  // solve J x = J rotated.col(k) for x in z only
      residual_.noalias() = core.constraints.J() * rotated.col(k);
      core.closure_step_in_z(residual_, step_);
      rho_dot_.col(k) -= step_;
    }
  }
  jacobian.setZero(2 * d, 2 * d);
  jacobian.topRightCorner(d, d).setIdentity();
  for (int k = 0; k < d; ++k) {
    const auto row = eq_1_.by_q.row(core.q[k]), row_v = eq_1_.by_v.row(core.q[k]);
    jacobian.row(d + k).head(d).noalias() = row * core.rho;
    jacobian.row(d + k).head(d).noalias() += row_v * rho_dot_;
    jacobian.row(d + k).tail(d).noalias() = row_v * core.rho;
  }
  if (!chart_.is_trivial()) chart_.transform_jacobian(core, core.q_tree, q_dot, jacobian);
  return jacobian.allFinite();
}

void LevelSet::rate_pairs(std::vector<std::pair<int, int>>& of) const {
  of.clear();
  const Indices& single = core.tree.single_dof;
  for (int k = 0; k < core.d; ++k)
    if (std::binary_search(single.begin(), single.end(), core.q[k])) of.emplace_back(k, core.d + k);
}

bool LevelSet::tree_acceleration(In f, Out a) const {
  if (!on_manifold_) return false;
  const auto q_ddot = f.segment(core.d, core.d);
  if (!has_tree_acceleration_) return core.tree_acceleration(q_ddot, a), true;
  a = a_tree_;  // implicit methods pass an f whose q_ddot differs from that of the right-hand side
  for (int k = 0; k < core.d; ++k) a += (q_ddot(k) - a_tree_(core.q[k])) * core.rho.col(k);
  return true;
}

void LevelSet::add_motion_velocity(Out y, In v) const {
  for (int k = 0; k < core.d; ++k) y(core.d + k) += v(core.q[k]);
}

void LevelSet::add_motion_displacement(Out y, In step) const {
  if (!chart_.is_trivial()) return;
  for (int k = 0; k < core.d; ++k) y(k) += step(core.q[k]);
}

void LevelSet::resume(double t, Out y) {
  reset_coordinates(core.q_tree);
  write_chart_coordinates(y);
  accepted_t_ = t;
}

bool LevelSet::return_to_accepted() {
  ++disagreements_, rejection_balance_ += rejection_weight;
  if (rejection_balance_ > max_rejection_balance) {
    if (!elimination.disable_elimination(core)) return fail(RhsFailure::z_inaccurate);
    rejection_balance_ = 0.0;  // steps may succeed with the other elimination
  }
  search_margin_ = std::numeric_limits<double>::infinity();
  predict_from_accepted();
  return true;
}

void LevelSet::predict_from_accepted() {
  core.set_configuration(accepted_q_tree_);
  core.compute_rho();
  predictor_.reset(core, accepted_q_tree_, !on_manifold_);
}

void LevelSet::full_motion(In f, Out x, Out x_dot) const {
  core.tree.configuration_rate(core.q_tree, velocity, x_dot.head(core.tree.nq));
  if (on_manifold_) {
    x << core.q_tree, velocity;
    tree_acceleration(f, x_dot.tail(core.n));
  } else {
    x << core.q_tree, q_dot;
    x_dot.tail(core.d) = f.segment(core.d, core.d);
  }
}

// y is rounded relative to its largest entry, such as a crank's angle after many turns, and z depends on it. An angle
// near zero is therefore no more accurate. Errors that a nearly singular phi_z amplifies are not rounding.
void LevelSet::add_rounding(In x, Out scale) const {
  const Vector& units = core.scales.columns;
  double largest = 0.0;
  for (int k : core.tree.single_dof) largest = std::max(largest, std::abs(x(core.tree.q_index[k])) / units(k));
  for (int k : core.tree.single_dof) scale(core.tree.q_index[k]) += rounding * largest * units(k);
  if (on_manifold_)
    scale.tail(core.n) += rounding * x.tail(core.n).cwiseQuotient(units).lpNorm<Eigen::Infinity>() * units;
}

// Off the manifold the motion of eq. 8 depends on the choice of q, because only z_dot closes the loops. There the
// partition does not change.
Accepted LevelSet::accept_motion(double t, Out y, double present_margin) {
  accepted_q_tree_ = last_q_tree_;
  elimination.accept_step(core);
  if (rejection_balance_ == 0.0) usual_step_ = t - accepted_t_;
  if (usual_step_ > 0.0) rejection_balance_ = std::max(0.0, rejection_balance_ - (t - accepted_t_) / usual_step_);
  accepted_t_ = t;
  update_w(t);
  if (!on_manifold_ && t - t_start_ > w_lifetime * epsilon_) return on_manifold_ = true, Accepted::changed;
  if (may_change_partition && present_margin < search_margin_ && !(w.lpNorm<Eigen::Infinity>() > tolerance_)) {
    search_margin_ = std::max(search_again_ratio * present_margin, min_margin);
    Partition candidate;
    if (sync_core(t, y) && find_best_partition(core, candidate) && candidate.q != core.q) {
      const Partition previous{core.q, core.z};
      if (change_partition(candidate, t, y)) {
        if (coordinate_margin() > min_margin_gain * present_margin) {
          ++counts.switches;
          disagreements_ = 0, rejection_balance_ = 0.0;
          return Accepted::restarted;
        }
        change_partition(previous, t, y);
        search_margin_ = std::max(search_again_ratio * present_margin, min_margin);
      }
    }
  }
  if (!(present_margin > chart_margin)) return Accepted::rejected;
  if (!chart_.needs_new_reference(y.head(core.d))) return Accepted::unchanged;
  if (!sync_core(t, y)) return Accepted::rejected;
  reset_coordinates(core.q_tree);
  write_chart_coordinates(y);
  return Accepted::restarted;
}

// Express the core's state in another partition. False if its phi_z is singular.
bool LevelSet::change_partition(const Partition& partition, double t, Out y) {
  const Vector q_tree = core.q_tree, v = velocity;
  core.set_partition(partition.q, partition.z);
  z_.setZero(core.z.size());
  core.set_configuration(q_tree);
  core.compute_rho();
  reset_coordinates(q_tree);
  write_chart_coordinates(y);
  for (int k = 0; k < core.d; ++k) y(core.d + k) = v(core.q[k]);
  return !core.phi_z.singular() && sync_core(t, y);
}

bool LevelSet::restore_partition(double t, Out y, bool& changed) {
  changed = core.q != fixed_partition_.q;
  if (!changed) return true;
  return sync_core(t, y) && change_partition(fixed_partition_, t, y) && coordinate_margin() > chart_margin;
}

}  // namespace ckc
