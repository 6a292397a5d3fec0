// The sensitivities of a motion as an integrand: one column (sensitivity of q', sensitivity of v') for each parameter.
#pragma once

#include "motion/integrand.hpp"
#include "sensitivity/sensitivities.hpp"

namespace ckc {

class SensitivityIntegrand final : public Integrand {
 public:
  SensitivityIntegrand(System& system, SensitivityTable table);

  Matrix state_sensitivities(In y) const { return columns(y); }  // (2 n, parameters)
  // Derivative of the time of an arrival with respect to each parameter. The core is at y, accelerating with a.
  Vector time_shift(const JointArrival& arrival, In y, In a) const;

  Sensitivities sensitivities;
  // Set if the motion is not differentiable from here on.
  std::optional<NonDifferentiableEvent> non_differentiable_event;
  double impact_at = std::numeric_limits<double>::quiet_NaN();  // s, time of the last impact

  int size() const override { return rows_ * sensitivities.count; }
  void start(In q_tree, In v_tree, Out y) override;
  bool rates(In y, Out y_dot) override;
  bool jacobian(In y, Matrix& of_column) override;
  void rate_pairs(std::vector<std::pair<int, int>>& of) const override;
  void accept_step(In y) override;
  bool before_transition(double t, In y, const std::vector<JointArrival>& arrivals) override;
  bool at_impact(In step, const Indices& at, const Matrix& responses, In x, double restitution) override;
  bool after_transition(double t, Out y, const std::vector<JointArrival>& arrivals, double rtol, double atol) override;
  bool stays_locked(double atol) override;
  bool control_sampled(In y, bool& changed) override;
  int record_size() const override;
  void fill_record(In y, Out row) override;

 private:
  Eigen::Map<const Matrix> columns(In y) const { return {y.data() + system_.coupled_size(), rows_, sensitivities.count}; }
  void load(In y) { s_ = columns(y); }
  void store(Out y) const { y.segment(system_.coupled_size(), size()) = s_.reshaped(); }
  bool general_rates(In y, In y_dot);  // by Pinocchio's terms

  System& system_;
  const int rows_;                 // of a column, 2 n
  const bool only_initial_state_;  // whether all parameters act on the initial state only
  Matrix s_, s_dot_, u_, tau_;
  Vector v_, a_;
  double transition_time_ = 0.0;  // s, of the present joint transition
};

}  // namespace ckc
