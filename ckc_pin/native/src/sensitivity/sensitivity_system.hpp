// A formulation extended by sensitivities: its state is y = (y of the formulation, sensitivities of q' and v' by
// parameter).
#pragma once

#include <algorithm>
#include <type_traits>

#include "motion/dae.hpp"
#include "motion/level_set.hpp"
#include "sensitivity/sensitivities.hpp"

namespace ckc {

class SensitivityResults {
 public:
  virtual ~SensitivityResults() = default;
  virtual Sensitivities& sensitivities() = 0;
  virtual Matrix state_sensitivities(In y) const = 0;  // (2 n, parameters)
  // set if the motion is not differentiable from here on
  std::optional<NonDifferentiableEvent> non_differentiable_event;
  double impact_at = std::numeric_limits<double>::quiet_NaN();  // s, time of the last impact
};

template <class Base>
class SensitivitySystem : public Base, public SensitivityResults {
 public:
  template <class... Arguments>
  SensitivitySystem(SensitivityTable table, Arguments&&... arguments)
      : Base(std::forward<Arguments>(arguments)...),
        size_(Base::size),
        only_initial_state_(std::all_of(table.parameters.begin(), table.parameters.end(),
                                        [](const SensitivityParameter& of) { return of.derivatives.empty(); })),
        sensitivities_(*this, std::move(table)) {
    this->size = size_ + 2 * sensitivities_.n * sensitivities_.count;
    this->crosses_singularities = false;
  }

  Sensitivities& sensitivities() override { return sensitivities_; }
  Matrix state_sensitivities(In y) const override {
    return Eigen::Map<const Matrix>(y.data() + size_, rows(), sensitivities_.count);
  }

  void start(double t, In q_tree, In v, In w, Out y) override {
    Base::start(t, q_tree, v, w, y.head(size_));
    non_differentiable_event.reset(), impact_at = std::numeric_limits<double>::quiet_NaN();
    this->core.set_configuration(q_tree);
    if (!sensitivities_.start(v, s_)) s_.setConstant(2 * sensitivities_.n, sensitivities_.count, std::nan(""));
    store(y);
  }

  bool rhs(double t, In y, Out y_dot) override {
    if (!Base::rhs(t, y.head(size_), y_dot.head(size_))) return false;
    Eigen::Map<Matrix> s_dot(y_dot.data() + size_, rows(), sensitivities_.count);
    if (compiled_rates(y, s_dot) && finite(y_dot.tail(this->size - size_))) return true;
    load(y);
    if (!rates(t, y, y_dot)) {
      const Control& control = this->control;
      if (sensitivities_.at_torque_pole()) return this->fail(RhsFailure::torque_pole);
      return this->fail(control.limited_motors.exist && control.is_redundant()
                            ? RhsFailure::allocation_not_differentiable
                            : RhsFailure::not_finite);
    }
    s_dot = s_dot_;
    return true;
  }

  bool sync_core(double t, In y) override { return Base::sync_core(t, y.head(size_)); }
  bool sync_core_at_start(double t, In y) override { return Base::sync_core_at_start(t, y.head(size_)); }
  bool sync_core_at_last_rhs(double t, In y) override { return Base::sync_core_at_last_rhs(t, y.head(size_)); }
  bool set_core_configuration(In y) override { return Base::set_core_configuration(y.head(size_)); }
  Accepted accept_step(double t, Out y, double margin) override {
    sensitivities_.accept();
    if (this->core.joints.has_events())
      sensitivities_.record_column_sizes(Eigen::Map<const Matrix>(y.data() + size_, rows(), sensitivities_.count));
    return Base::accept_step(t, y.head(size_), margin);
  }
  bool restore_partition(double t, Out y, bool& changed) override {
    return Base::restore_partition(t, y.head(size_), changed);
  }
  bool reduce_to_freedoms(In y, Matrix& jacobian) override { return Base::reduce_to_freedoms(y.head(size_), jacobian); }
  bool tree_acceleration(In f, Out a) const override { return Base::tree_acceleration(f.head(size_), a); }
  void full_motion(In f, Out x, Out x_dot) const override { Base::full_motion(f.head(size_), x, x_dot); }
  int auxiliary_size() const override { return this->size - size_; }
  void add_velocity(Out y, In v) const override { Base::add_velocity(y.head(size_), v); }
  void add_displacement(Out y, In step) const override { Base::add_displacement(y.head(size_), step); }
  void resume(double t, Out y) override { Base::resume(t, y.head(size_)); }

  // Jacobian of the motion alone. The sensitivities' own block is `auxiliary_jacobian`; their dependence on the
  // motion is neglected in the Newton iteration.
  bool jacobian(double t, In y, Matrix& jacobian, long& evaluations) override {
    const long differences = this->counts.differences;
    if (!Base::jacobian(t, y.head(size_), jacobian, evaluations)) return false;
    const bool of_dae = std::is_same_v<Base, Dae>, known = this->counts.differences == differences;
    if (of_dae && !known) Base::sync_core_at_last_rhs(t, y.head(size_));
    v_ = !of_dae ? this->v_tree : known ? Vector(y.segment(this->core.tree.nq, sensitivities_.n)) : this->velocity;
    if (!known && !this->acceleration_derivatives(Vector(this->core.q_tree), v_, this->zero_correction_)) return false;
    const int n = sensitivities_.n;
    block_.setZero(2 * n, 2 * n), block_.topRightCorner(n, n).setIdentity();
    if (!this->core.tree.roots.empty()) block_.topLeftCorner(n, n) = -this->core.tree.bracket_matrix(v_);
    block_.bottomLeftCorner(n, n) = this->eq_1_.by_q, block_.bottomRightCorner(n, n) = this->eq_1_.by_v;
    return block_.allFinite();
  }
  bool motion_rhs(double t, In y, Out y_dot) override { return Base::rhs(t, y, y_dot); }
  const Matrix* auxiliary_jacobian() const override { return &block_; }
  void auxiliary_rate_pairs(std::vector<std::pair<int, int>>& of) const override {
    of.clear();
    for (int k : this->core.tree.single_dof) of.emplace_back(k, sensitivities_.n + k);
  }

  bool before_transition(double t, In y, const std::vector<System::JointArrival>& arrivals) override {
    load(y), a_.resize(sensitivities_.n), v_ = this->velocity, transition_time_ = t;
    return this->acceleration(t, a_) && sensitivities_.before_transition(v_, a_, arrivals, s_);
  }
  bool at_impact(In step, const Indices& at, const Matrix& responses, In x, double restitution) override {
    impact_at = transition_time_;
    if (!sensitivities_.at_impact(v_, step, at, responses, x, restitution, s_)) return false;
    v_ += step;
    return true;
  }
  bool after_transition(double t, Out y, const std::vector<System::JointArrival>& arrivals, double rtol,
                        double atol) override {
    if (!this->acceleration(t, a_) || !sensitivities_.project_sensitivities(this->velocity, s_)) return false;
    if ((non_differentiable_event = sensitivities_.find_non_differentiable(arrivals, s_, rtol, atol))) return false;
    sensitivities_.after_transition(this->velocity, a_, s_);
    store(y);
    return true;
  }
  bool stays_locked(double atol) override {
    return !(non_differentiable_event = sensitivities_.find_marginally_locked(atol));
  }
  bool control_sampled(In y, bool& changed) override {
    if (!this->control.sampling->holds_output) return true;
    load(y);
    return sensitivities_.control_sampled(s_, *this->control.sampling, changed) || this->fail(RhsFailure::not_finite);
  }
  int extra_columns() const override {
    return (rows() + this->core.d + static_cast<int>(this->control.tau.size())) * sensitivities_.count;
  }
  void write_extra_columns(In y, Out row) override {
    load(y);
    sensitivities_.force_sensitivities(this->velocity, s_, u_, tau_);
    double* column = row.data();
    for (const Matrix* x : {&s_, &u_, &tau_}) column = std::copy(x->data(), x->data() + x->size(), column);
  }

 private:
  int rows() const { return 2 * sensitivities_.n; }
  void load(In y) { s_ = Eigen::Map<const Matrix>(y.data() + size_, rows(), sensitivities_.count); }
  // Rates by compiled terms, at the state of the last right-hand side.
  bool compiled_rates(In y, Eigen::Ref<Matrix> s_dot) {
    if (!sensitivities_.has_compiled_terms()) return false;
    const Eigen::Map<const Matrix> s(y.data() + size_, rows(), sensitivities_.count);
    if constexpr (std::is_same_v<Base, Dae>) {
      return sensitivities_.compiled_rates(this->q_tree_, y.segment(this->q_tree_.size(), sensitivities_.n), s, s_dot);
    } else {
      return sensitivities_.compiled_rates(this->core.q_tree, this->v_tree, s, s_dot);
    }
  }
  bool rates(double t, In y, In y_dot) {
    if (std::is_same_v<Base, Dae>) Base::sync_core_at_last_rhs(t, y.head(size_));
    v_ = std::is_same_v<Base, Dae> ? this->velocity : this->v_tree;
    a_.resize(sensitivities_.n);
    if (!Base::tree_acceleration(y_dot.head(size_), a_)) return false;
    if (!only_initial_state_ || !this->core.compiled || sensitivities_.has_held_output())
      return sensitivities_.rates(v_, a_, s_, s_dot_);
    this->core.set_velocity(v_);
    if (!this->acceleration_derivatives(Vector(this->core.q_tree), v_, this->zero_correction_)) return false;
    sensitivities_.initial_state_rates(v_, this->eq_1_.by_q, this->eq_1_.by_v, s_, s_dot_);
    return true;
  }
  void store(Out y) const { Eigen::Map<Matrix>(y.data() + size_, rows(), sensitivities_.count) = s_; }

  const int size_;                 // of the formulation's y
  const bool only_initial_state_;  // all parameters act on the initial state only
  Sensitivities sensitivities_;
  Matrix s_, s_dot_, block_, u_, tau_;
  Vector v_, a_;
  double transition_time_ = 0.0;  // s, time of the present joint transition
};

}  // namespace ckc
