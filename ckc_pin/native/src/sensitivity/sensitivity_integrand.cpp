#include "sensitivity/sensitivity_integrand.hpp"

#include <algorithm>

namespace ckc {

static bool act_on_initial_state_only(const SensitivityTable& table) {
  return std::all_of(table.parameters.begin(), table.parameters.end(),
                     [](const SensitivityParameter& parameter) { return parameter.derivatives.empty(); });
}

SensitivityIntegrand::SensitivityIntegrand(System& system, SensitivityTable table)
    : sensitivities(system, table),
      system_(system),
      rows_(2 * sensitivities.n),
      only_initial_state_(act_on_initial_state_only(table)) {}

Vector SensitivityIntegrand::time_shift(const JointArrival& arrival, In y, In a) const {
  return sensitivities.time_shift(arrival, system_.velocity, a, columns(y));
}

void SensitivityIntegrand::start(In q_tree, In v_tree, Out y) {
  non_differentiable_event.reset(), impact_at = std::numeric_limits<double>::quiet_NaN();
  system_.core.set_configuration(q_tree);
  if (!sensitivities.start(v_tree, s_)) s_.setConstant(rows_, sensitivities.count, std::nan(""));
  store(y);
}

bool SensitivityIntegrand::rates(In y, Out y_dot) {
  Eigen::Map<Matrix> s_dot(y_dot.data() + system_.coupled_size(), rows_, sensitivities.count);
  if (sensitivities.has_compiled_terms() &&
      sensitivities.compiled_rates(system_.configuration_at_last_rhs(), system_.v_tree, columns(y), s_dot) &&
      finite(s_dot.reshaped()))
    return true;
  load(y);
  if (!general_rates(y, y_dot)) {
    const Control& control = system_.control;
    system_.failure = sensitivities.at_torque_pole() ? RhsFailure::torque_pole
                      : control.limited_motors.exist && control.is_redundant()
                          ? RhsFailure::allocation_not_differentiable
                          : RhsFailure::not_finite;
    return false;
  }
  s_dot = s_dot_;
  return true;
}

bool SensitivityIntegrand::general_rates(In y, In y_dot) {
  system_.move_core_to_last_rhs(y);
  v_ = system_.v_tree, a_.resize(sensitivities.n);
  if (!system_.tree_acceleration(y_dot, a_)) return false;
  Core& core = system_.core;
  if (!only_initial_state_ || !core.compiled || sensitivities.has_held_output())
    return sensitivities.rates(v_, a_, s_, s_dot_);
  core.set_velocity(v_);
  if (!system_.acceleration_derivatives(Vector(core.q_tree), v_)) return false;
  const AccelerationDerivatives& acceleration = *system_.eq_1_derivatives();
  sensitivities.initial_state_rates(v_, acceleration.by_q, acceleration.by_v, s_, s_dot_);
  return true;
}

// Newton's iteration neglects the dependence of the columns on the motion.
bool SensitivityIntegrand::jacobian(In y, Matrix& of_column) {
  Core& core = system_.core;
  if (!system_.eq_1_derivatives()) {  // finite differences have moved the core
    system_.move_core_to_last_rhs(y);
    if (!system_.acceleration_derivatives(Vector(core.q_tree), Vector(system_.v_tree))) return false;
  }
  const AccelerationDerivatives& acceleration = *system_.eq_1_derivatives();
  const int n = sensitivities.n;
  of_column.setZero(2 * n, 2 * n), of_column.topRightCorner(n, n).setIdentity();
  if (!core.tree.roots.empty()) of_column.topLeftCorner(n, n) = -core.tree.bracket_matrix(system_.v_tree);
  of_column.bottomLeftCorner(n, n) = acceleration.by_q, of_column.bottomRightCorner(n, n) = acceleration.by_v;
  return of_column.allFinite();
}

void SensitivityIntegrand::rate_pairs(std::vector<std::pair<int, int>>& of) const {
  of.clear();
  for (int k : system_.core.tree.single_dof) of.emplace_back(k, sensitivities.n + k);
}

void SensitivityIntegrand::accept_step(In y) {
  sensitivities.accept();
  if (system_.core.joints.has_events()) sensitivities.record_column_sizes(columns(y));
}

bool SensitivityIntegrand::before_transition(double t, In y, const std::vector<JointArrival>& arrivals) {
  load(y), a_.resize(sensitivities.n), v_ = system_.velocity, transition_time_ = t;
  return system_.acceleration(t, a_) && sensitivities.before_transition(v_, a_, arrivals, s_);
}

bool SensitivityIntegrand::at_impact(In step, const Indices& at, const Matrix& responses, In x, double restitution) {
  impact_at = transition_time_;
  if (!sensitivities.at_impact(v_, step, at, responses, x, restitution, s_)) return false;
  v_ += step;
  return true;
}

bool SensitivityIntegrand::after_transition(double t, Out y, const std::vector<JointArrival>& arrivals, double rtol,
                                            double atol) {
  if (!system_.acceleration(t, a_) || !sensitivities.project_sensitivities(system_.velocity, s_)) return false;
  if ((non_differentiable_event = sensitivities.find_non_differentiable(arrivals, s_, rtol, atol))) return false;
  sensitivities.after_transition(system_.velocity, a_, s_);
  store(y);
  return true;
}

bool SensitivityIntegrand::stays_locked(double atol) {
  return !(non_differentiable_event = sensitivities.find_marginally_locked(atol));
}

bool SensitivityIntegrand::control_sampled(In y, bool& changed) {
  const Sampling& sampling = *system_.control.sampling;
  load(y);
  if (sensitivities.control_sampled(s_, sampling, changed)) return true;
  return system_.failure = RhsFailure::not_finite, false;
}

int SensitivityIntegrand::record_size() const {
  return (rows_ + system_.core.d + static_cast<int>(system_.control.tau.size())) * sensitivities.count;
}

void SensitivityIntegrand::fill_record(In y, Out row) {
  load(y);
  sensitivities.force_sensitivities(system_.velocity, s_, u_, tau_);
  double* column = row.data();
  for (const Matrix* x : {&s_, &u_, &tau_}) column = std::copy(x->data(), x->data() + x->size(), column);
}

}  // namespace ckc
