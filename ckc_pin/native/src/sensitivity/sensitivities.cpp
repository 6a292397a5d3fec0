#include "sensitivity/sensitivities.hpp"

#include <algorithm>

#include <Eigen/LU>

#include "loops/compiled_terms.hpp"

namespace ckc {

constexpr double min_relative_stiffness = 1e-12;  // below it an equilibrium is not isolated

static bool is_applied(const ParameterDerivative& of) {
  return of.kind == ParameterDerivative::friction || of.kind == ParameterDerivative::gain_q ||
         of.kind == ParameterDerivative::gain_q_dot || of.kind == ParameterDerivative::target ||
         of.kind == ParameterDerivative::gear || of.kind == ParameterDerivative::torque_limit;
}

Sensitivities::Sensitivities(System& system, SensitivityTable table)
    : n(system.core.n),
      count(static_cast<int>(table.parameters.size())),
      system_(system),
      core_(system.core),
      table_(std::move(table)),
      tree_(table_.model, table_.q_index),
      derivatives_(tree_, table_.closure, table_.springs) {
  const int m = core_.constraints.closure.rows;
  q_.setZero(tree_.nq), v_.setZero(tree_.n), a_.setZero(tree_.n), tree_force_.setZero(tree_.n);
  time_shift_.setZero(1 + *std::max_element(table_.part.begin(), table_.part.end()), count),
      largest_norm_.setZero(count);
  locked_correction_.setZero(n), applied_force_.setZero(n), residual_force_.setZero(n), lambda_.setZero(m);
  force_.setZero(n, count), row_.setZero(m, count), derivative_.setZero(n, count);
  for (const SensitivityParameter& of : table_.parameters)
    has_applied_derivatives_ |= std::any_of(of.derivatives.begin(), of.derivatives.end(), is_applied);
  const auto d = static_cast<Eigen::Index>(table_.fixed_q.size());
  for (Vector* x : {&fixed_q_, &fixed_q_dot_, &u_derivative_}) x->setZero(d);
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives) {
      if (of.kind != ParameterDerivative::gain_q && of.kind != ParameterDerivative::gain_q_dot) continue;
      const Matrix gain = of.numbers.reshaped(d, d), none = Matrix::Zero(d, d);
      gains_.push_back(of.kind == ParameterDerivative::gain_q ? Gain{p, gain, none} : Gain{p, none, gain});
    }
}

void Sensitivities::compute(In v, In a, In lambda, bool impulsive) {
  for (size_t k = 0; k < table_.real_q.size(); ++k) q_(table_.real_q[k]) = core_.q_tree(static_cast<Eigen::Index>(k));
  for (int k = 0; k < n; ++k) v_(table_.real_v[k]) = v(k), a_(table_.real_v[k]) = a(k);
  derivatives_.compute(q_, v_, a_, lambda, impulsive);
}

// Add to x the step of z that reduces the residuals to zero.
void Sensitivities::solve_dependent(const Matrix& residuals, Matrix& x) {
  Vector step(n);
  for (int p = 0; p < count; ++p) {
    core_.closure_step_in_z(residuals.col(p), step);
    x.col(p) += step;
  }
}

// At rest at the core's configuration, with given sensitivities of the independent coordinates: complete these, and
// compute the stiffness and the derivative of the force on q that keeps the mechanism in equilibrium.
void Sensitivities::compute_balance(Matrix& q, Matrix& force_derivative, Matrix& stiffness) {
  const Vector none = Vector::Zero(n);
  Vector lambda = Vector::Zero(core_.constraints.closure.rows), u(core_.d);
  core_.set_velocity(none), core_.compute_bias(), core_.compute_rho();
  Vector residual_force = core_.bias_tree;
  core_.multiply_rho_transposed(residual_force, u);
  for (int k = 0; k < core_.d; ++k) residual_force(core_.q[k]) -= u(k);
  core_.minimum_norm_multipliers(residual_force, lambda);
  compute(none, none, lambda, false);
  Matrix phi_derivative, phi_dot_derivative;
  closure_derivatives(none, phi_derivative, phi_dot_derivative);
  solve_dependent(core_.constraints.J() * q + phi_derivative, q);
  force_.setZero(n, count), row_.setZero(core_.constraints.closure.rows, count);
  add_parameters(none, none, lambda, false, force_, row_);
  Matrix by_q(n, n);
  for (int k = 0; k < n; ++k)
    for (int i = 0; i < n; ++i) by_q(i, k) = derivatives_.force_by_q(table_.real_v[i], table_.real_v[k]);
  force_derivative = core_.rho.transpose() * (force_ + by_q * q);
  stiffness = core_.rho.transpose() * by_q * core_.rho;
}

// Parameters define the initial sensitivities of the independent coordinates. The sensitivities of the dependent ones
// follow from the closure.
bool Sensitivities::start(In v, Matrix& s) {
  compiled_evaluations = general_evaluations = 0;
  queued_.clear(), held_output_.resize(0, 0);
  largest_norm_.setZero(), time_shift_.setZero(), before_first_transition_ = true;
  torque_pole_ = false, torque_limit_side_.clear();
  const Vector q_tree = core_.q_tree, none = Vector::Zero(n), no_force = Vector::Zero(core_.constraints.closure.rows);
  s.setZero(2 * n, count);
  compensation_.setZero(core_.d, count);
  Matrix q = Matrix::Zero(n, count), force_derivative, stiffness, phi_derivative, phi_dot_derivative;
  if (table_.target.size()) {
    core_.set_configuration(table_.target), core_.compute_rho();
    compute_balance(q, compensation_, stiffness);
    for (int p = 0; p < count; ++p)
      for (const ParameterDerivative& of : table_.parameters[p].derivatives)
        if (of.kind == ParameterDerivative::target) compensation_.col(p) += stiffness.col(of.index) + of.numbers;
    q.setZero(), core_.set_configuration(q_tree);
  }
  core_.compute_rho();
  Matrix q_dot_derivative = Matrix::Zero(n, count);
  for (int p = 0; p < count; ++p) {
    for (int k : core_.q) q(k, p) = table_.parameters[p].q(k);
    for (int k = 0; k < core_.d; ++k) q_dot_derivative(core_.q[k], p) = table_.parameters[p].q_dot(k);
  }
  compute(v, none, no_force, false);
  closure_derivatives(v, phi_derivative, phi_dot_derivative);
  if (!table_.at_equilibrium && q.isZero(0) && q_dot_derivative.isZero(0) && phi_derivative.isZero(0) &&
      phi_dot_derivative.isZero(0))
    return true;
  if (core_.phi_z.singular() || system_.phi_z_margin() < chart_margin) return false;
  if (table_.at_equilibrium) {
    compute_balance(q, force_derivative, stiffness);
    Eigen::FullPivLU<Matrix> factorization(stiffness);
    factorization.setThreshold(min_relative_stiffness);
    if (!factorization.isInvertible()) return false;
    q -= core_.rho * factorization.solve(force_derivative);
    compute(v, none, no_force, false);
  } else {
    solve_dependent(core_.constraints.J() * q + phi_derivative, q);
  }
  s.topRows(n) = q;
  for (int k = 0; k < n; ++k) phi_dot_derivative += derivatives_.rate_by_q.col(table_.real_v[k]) * q.row(k);
  solve_dependent(core_.constraints.J() * q_dot_derivative + phi_dot_derivative, q_dot_derivative);
  s.bottomRows(n) = q_dot_derivative;
  return s.allFinite();
}

bool Sensitivities::compute_applied_force(In v) {
  Joints& joints = core_.joints;
  const Control& control = system_.control;
  has_feedback_ = control.is_feedback() || joints.exerts_force(), torque_pole_ = false;
  limited_tau_.resize(0, 0);
  if (!has_feedback_ && !control.is_active()) {
    applied_force_ = control.u_tree;
  } else {
    if (!system_.control.derivatives(core_, u_by_q_, u_by_v_, applied_force_)) return false;
    for (size_t k = 0; k < torque_limit_side_.size(); ++k)
      torque_pole_ |= torque_limit_side_[k] * torque_limit_side(static_cast<int>(k)) < 0;
    if (torque_pole_) return false;
    if (control.is_active() && control.limited_motors.exist) has_feedback_ = true, limited_motor_sensitivities(v);
  }
  if (joints.exerts_force()) {
    joints.add_friction_force(v, applied_force_);
    locked_correction_.setZero(), joints.add_friction_derivative(v, locked_correction_);
    u_by_v_.diagonal() += locked_correction_;
  }
  for (size_t i = 0; i < joints.locked.size(); ++i)
    applied_force_(joints.locked[i]) += joints.holding_forces()(static_cast<Eigen::Index>(i));
  return true;
}

int Sensitivities::torque_limit_side(int motor) const {
  const Control& control = system_.control;
  return control.limit_side(motor);
}

double Sensitivities::limited_torque_derivative(const ParameterDerivative& of) const {
  const int side = torque_limit_side(of.index);
  return side ? of.numbers(side > 0 ? 1 : 0) : 0.0;
}

void Sensitivities::accept() {
  const Control& control = system_.control;
  torque_limit_side_.resize(control.is_active() && control.is_feedback() ? static_cast<size_t>(control.tau.size()) : 0);
  for (size_t k = 0; k < torque_limit_side_.size(); ++k) torque_limit_side_[k] = torque_limit_side(static_cast<int>(k));
}

// Add the response of controls and friction to the state.
void Sensitivities::add_feedback(const Eigen::Ref<const Matrix>& s) {
  force_.noalias() += u_by_q_ * s.topRows(n);
  force_.noalias() += u_by_v_ * s.bottomRows(n);
}

void Sensitivities::add_locked_correction(Matrix& acceleration) {
  free_derivative_ = acceleration;
  locked_force_derivative_.resize(static_cast<Eigen::Index>(core_.joints.locked.size()), count);
  for (int p = 0; p < count; ++p) {
    core_.joints.compute_correction(responses_, acceleration.col(p), locked_correction_);
    acceleration.col(p) += locked_correction_, locked_force_derivative_.col(p) = core_.joints.correction_forces();
  }
}

bool Sensitivities::rates(In v, In a, const Matrix& s, Matrix& s_dot) {
  ++general_evaluations;
  const bool locked = !core_.joints.locked.empty();
  if (!compute_applied_force(v)) return false;
  core_.set_velocity(v), core_.compute_bias(), core_.compute_D_tree();
  core_.multiply_D_tree(a, residual_force_);
  residual_force_ += core_.bias_tree - core_.damping_tree - applied_force_;
  core_.minimum_norm_multipliers(residual_force_, lambda_);
  compute(v, a, lambda_, false);
  force_.setZero(), row_.setZero();
  add_parameters(v, a, lambda_, false, force_, row_);
  add_applied_derivatives(core_.q_tree, v, force_);
  add_state_derivatives(s);
  force_ = -force_;
  if (has_feedback_) add_feedback(s);
  if (!core_.solve_acceleration_derivatives(force_, row_, derivative_)) return false;
  if (locked) {
    if (!core_.unit_force_responses(core_.joints.locked, responses_)) return false;
    add_locked_correction(derivative_);
  }
  s_dot.resize(2 * n, count), configuration_rate_sensitivities(v, s, s_dot);
  s_dot.bottomRows(n) = derivative_;
  return s_dot.allFinite();
}

bool Sensitivities::has_compiled_terms() const {
  // They differentiate eq. 1 without prescribed accelerations.
  return core_.compiled && !core_.has_row_motion() && core_.compiled->has_directional_derivatives() &&
         table_.directions.rows() == core_.compiled->parameter_count();
}

// Compiled terms may become available during the run, so this is called at their first use.
void Sensitivities::prepare_compiled() {
  for (int first = 0; first < count; first += core_.compiled->lanes()) {
    const int group_size = std::min(count - first, core_.compiled->lanes()),
              rows = group_size == 1 ? 1 : core_.compiled->lanes();
    DirectionGroup& group = direction_groups_.emplace_back(DirectionGroup{first, group_size, {}, {}});
    group.derivatives.setZero(rows, n), group.directions.setZero(rows, core_.compiled->direction_size());
  }
  for (int p = 0; p < count; ++p)
    parameter_groups_.push_back(core_.compiled->parameter_groups(table_.directions.col(p)));
  direction_.setZero(core_.compiled->direction_size()), group_direction_.setZero(direction_.size() - 2 * n);
}

// Assemble the direction of parameter p for the compiled terms. force_ contains derivatives of the applied force if
// `force_changes`.
void Sensitivities::assemble_direction(const Eigen::Ref<const Matrix>& s, int p, bool force_changes, Out direction) {
  direction.head(2 * n) = s.col(p);
  auto added = direction.tail(group_direction_.size());
  added.setZero();
  if (force_changes) added.head(n) = force_.col(p);
  for (int parameter_group : parameter_groups_[static_cast<size_t>(p)]) {
    core_.compiled->parameter_direction(parameter_group, table_.directions.col(p), group_direction_);
    added += group_direction_;
  }
}

bool Sensitivities::compiled_rates(In q_tree, In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) {
  const bool locked = !core_.joints.locked.empty();
  if (!compute_applied_force(v) || !core_.compiled->prepare_derivatives(q_tree, v, applied_force_)) return false;
  if (direction_groups_.empty()) prepare_compiled();
  ++compiled_evaluations;
  const bool force_changes = has_feedback_ || has_applied_derivatives_ || has_held_output();
  if (force_changes) force_.setZero(), add_applied_derivatives(q_tree, v, force_), force_ = -force_;
  if (has_feedback_) add_feedback(s);
  configuration_rate_sensitivities(v, s, s_dot);
  for (DirectionGroup& group : direction_groups_) {
    if (group.directions.rows() == 1) {
      assemble_direction(s, group.first, force_changes, direction_);
      core_.compiled->directional_derivative(direction_, s_dot.col(group.first).tail(n));
      continue;
    }
    for (int row = 0; row < group.count; ++row) {
      assemble_direction(s, group.first + row, force_changes, direction_);
      group.directions.row(row) = direction_;
    }
    core_.compiled->directional_derivatives(group.directions, group.derivatives);
    for (int row = 0; row < group.count; ++row) s_dot.col(group.first + row).tail(n) = group.derivatives.row(row);
  }
  if (locked) {
    if (!core_.unit_force_responses(core_.joints.locked, responses_)) return false;
    derivative_ = s_dot.bottomRows(n);
    add_locked_correction(derivative_);
    s_dot.bottomRows(n) = derivative_;
  }
  return true;
}

void Sensitivities::configuration_rate_sensitivities(In v, const Eigen::Ref<const Matrix>& s,
                                                     Eigen::Ref<Matrix> s_dot) const {
  for (int p = 0; p < count; ++p) {
    s_dot.col(p).head(n) = s.col(p).tail(n);
    core_.tree.add_bracket(s.col(p).head(n), v, s_dot.col(p).head(n));
  }
}

void Sensitivities::initial_state_rates(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s,
                                        Matrix& s_dot) const {
  s_dot.resize(2 * n, count), configuration_rate_sensitivities(v, s, s_dot);
  s_dot.bottomRows(n).noalias() = by_q * s.topRows(n);
  s_dot.bottomRows(n).noalias() += by_v * s.bottomRows(n);
}

// Add the derivatives with respect to the state to force_ and row_.
void Sensitivities::add_state_derivatives(const Matrix& s) {
  const DynamicsDerivatives& by = derivatives_;
  for (int p = 0; p < count; ++p)
    for (int k = 0; k < n; ++k) {
      const int at = table_.real_v[k];
      const double x = s(k, p), x_dot = s(n + k, p);
      for (Eigen::Index i = 0; i < row_.rows(); ++i) row_(i, p) += by.row_by_q(i, at) * x + by.row_by_v(i, at) * x_dot;
      for (int i = 0; i < n; ++i) {
        const int of = table_.real_v[i];
        force_(i, p) += by.force_by_q(of, at) * x + by.force_by_v(of, at) * x_dot;
      }
    }
}

}  // namespace ckc
