// Control of a mechanism: none, a constant u, or a controller of the paper or of the user, sampled or continuous,
// through motors with limits.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "control/allocation.hpp"
#include "control/desired.hpp"
#include "control/measured_state.hpp"
#include "control/sensor.hpp"

namespace ckc {

class Controller {
 public:
  virtual ~Controller() = default;
  // Compute eq. 6's force u, or motor torques. If there is none, return false and set `failure`.
  virtual bool compute_u(const MeasuredState& at, Out u, ControlFailure& failure) = 0;
  virtual bool outputs_torques() const { return false; }
  // State of the law itself, such as the integral of an error: its initial value, its present one, which the caller
  // sets, and its rate where u was computed last. Empty if the law has none.
  virtual Vector initial_state() const { return {}; }
  Vector state;
  virtual bool state_rate(const MeasuredState&, Out /*rate*/, ControlFailure&) { return true; }
  // Times from now on lie in [begin, end], see Trajectory.
  virtual void set_segment(double /*begin*/, double /*end*/, double /*tolerance*/) {}
  // Move the desired q from its present value at `begin` to x at `end`, at a constant rate, and hold it there, until the
  // next reset. False if the law has no desired q that can be replaced, or none at `begin`.
  virtual bool move_desired(double /*begin*/, double /*end*/, In /*x*/) { return false; }
  virtual void reset() {}
  // Value of the Lyapunov function, NaN if there is none. `w`: present value of phi.
  virtual double lyapunov(const MeasuredState&, double, In) { return std::numeric_limits<double>::quiet_NaN(); }
  // Whether it uses terms in the fixed partition, not only q and q_dot.
  virtual bool needs_terms() const { return true; }
  // Whether the output depends on the choice of q.
  virtual bool needs_fixed_partition() const { return needs_terms(); }
  // Derivatives of the last output (u, or motor torques) with respect to q' (tangent) and v', at the core's state. The
  // matrices are zero on entry. False if unknown.
  virtual bool derivatives(Core&, const Indices& /*fixed_q*/, Matrix& /*by_q*/, Matrix& /*by_v*/) { return false; }
  // Directional derivative of u with respect to the gains (of positions, of rates); requires `derivatives`.
  virtual void gain_derivative(const MeasuredState&, const Matrix&, const Matrix&, Out derivative) {
    derivative.setZero();
  }
};

// Set-point controller, eq. 14.
class SetPointController : public Controller {
 public:
  SetPointController(Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential_d);
  bool compute_u(const MeasuredState& at, Out u, ControlFailure& failure) override;
  double lyapunov(const MeasuredState& at, double potential_energy, In w) override;
  bool needs_terms() const override { return false; }
  bool derivatives(Core&, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) override;
  void gain_derivative(const MeasuredState& at, const Matrix& K_P, const Matrix& K_V, Out derivative) override;

 private:
  Matrix K_P_, K_V_;
  Vector q_d_, h_d_;
  double potential_d_;
  Vector e_, product_;
};

// Tracking controller, eq. 16. `model`: the plant as the controller knows it, evaluated at the measured q' and at
// rho q_dot or the "actual" velocity; null: the plant itself.
class TrackingController : public Controller {
 public:
  TrackingController(Matrix Lambda, Matrix K_D, std::unique_ptr<Trajectory> desired, std::unique_ptr<Core> model,
                     bool actual);
  bool compute_u(const MeasuredState& at, Out u, ControlFailure& failure) override;
  void set_segment(double begin, double end, double tolerance) override {
    desired_->set_segment(begin, end, tolerance);
  }
  bool move_desired(double begin, double end, In x) override;
  void reset() override { commanded_.reset(); }
  double lyapunov(const MeasuredState& at, double potential_energy, In w) override;
  bool derivatives(Core& plant, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) override;
  void gain_derivative(const MeasuredState& at, const Matrix& Lambda, const Matrix& K_D, Out derivative) override;

 private:
  Matrix Lambda_, K_D_;
  std::unique_ptr<Trajectory> desired_, commanded_;  // `commanded_` replaces `desired_`, unless it is null
  std::unique_ptr<Core> model_;
  bool actual_;
  bool errors(const MeasuredState& at);
  Trajectory& desired() { return commanded_ ? *commanded_ : *desired_; }
  Vector e_, e_dot_, v_, a_, r_;  // errors and reference motion at the last measured state, for `derivatives`
  Vector product_, Lambda_e_, v_model_;
};

// Torques tabulated over time, piecewise constant or linearly interpolated.
class TorqueTable : public Controller {
 public:
  TorqueTable(Vector times, Matrix tau, bool interpolates)
      : times_(std::move(times)), tau_(std::move(tau)), interpolates_(interpolates) {}
  bool compute_u(const MeasuredState& at, Out tau, ControlFailure& failure) override;
  bool outputs_torques() const override { return true; }
  bool needs_terms() const override { return false; }
  // the torques do not depend on the state
  bool derivatives(Core&, const Indices&, Matrix&, Matrix&) override { return true; }

 private:
  Vector times_;
  Matrix tau_;  // one column per time
  bool interpolates_;
};

// Maps u to motor torques within their limits, and motor torques to forces on the tree.
class Actuation {
 public:
  struct Gear {
    int joint;
    double ratio;  // motor rate per joint rate
  };
  Actuation(const Core& core, std::vector<std::vector<Gear>> gears, bool is_direct, Allocation allocation);
  void allocate(Core& core, Out u, Out tau, Out u_tree);
  void apply_torques(Out tau, Out u_tree) const;  // clamps the requested torques
  void clamp(Out tau) const { allocation_.clamp(tau); }
  const std::vector<std::vector<Gear>> gears;
  const bool is_direct;  // one motor on each coordinate of q, so that tau = u
  bool is_redundant() const { return allocation_.is_redundant(); }
  // -1 if a motor is at its lower limit, 1 at its upper limit, else 0.
  int limit_side(const Vector& tau, Eigen::Index k) const {
    return tau(k) >= allocation_.upper(k) ? 1 : tau(k) <= allocation_.lower(k) ? -1 : 0;
  }

 private:
  void motor_forces(In tau, Out u_tree) const;
  Allocation allocation_;
  Matrix transmission_;
};

// Zero-order hold with a delay: samples at k period, acts from k period + delay.
struct Sampling {
  double period = 0.0, delay = 0.0;
  Vector times;  // sample times, if they are not periodic
  long next_sample = 0;                        // index of the next sample
  int samples_taken = 0, outputs_applied = 0;  // at the last instant
  // ring buffer of outputs waiting for their delay: (time, u)
  std::vector<std::pair<double, Vector>> queue;
  size_t queue_begin = 0, queue_size = 0;

  double time_tolerance(double t) const { return 1e-9 * period + 1e-15 * t; }  // instants closer than this coincide
  double next_sample_time() const;
  void start(double t);  // the last sample instant up to t comes next
  double next_instant() const;  // of a sample or of a delayed output
  void queue_output(double t, In u);
};

class Control {
 public:
  Control(const Core& core, Actuation actuation);

  std::unique_ptr<Controller> law;  // null: only `constant` acts
  std::optional<Sampling> sampling;
  std::optional<Sensor> sensor;
  std::optional<TorqueDrive> drive;
  Vector constant;  // constant or held output: u, (d), or one torque per motor
  bool constant_is_torque = false;
  ControlFailure failure;
  Vector u, tau, u_tree;  // present values: (d), (motors), (n)

  void start(double t);  // reset at the start of a run
  bool is_active() const { return law || !constant.isZero(0); }
  // Replace the constant u or torques. False if they are unchanged.
  bool set_constant(In value, bool outputs_torques);
  // Whether the motion must stay in the user's partition, because the control uses terms of that partition or is given
  // as eq. 6's force in it. Motor torques do not depend on a partition.
  bool needs_fixed_partition() const;
  // Whether evaluating the control between samples needs more of the state than q and q_dot.
  bool needs_terms() const {
    return is_active() && ((is_feedback() && law->needs_terms()) || !(actuation_.is_direct || outputs_torques()));
  }
  // Motors on other coordinates than q that do not produce the requested u, because some are at their limits. Set by
  // `derivatives`.
  struct LimitedMotors {
    bool exist = false;
    Matrix response;    // (motors, d): derivative of the torques with respect to the requested u
    Vector tau;         // torques without limits
    Vector lambda;      // multipliers with which these torques are equivalent to u on q
    Matrix by_q, by_v;  // (motors, n): derivatives of the torques
  };
  LimitedMotors limited_motors;
  // Derivatives with respect to q' and v' of a force that is equivalent to the last u_tree: `force`, which is eq. 6's
  // force on q where the motors produce it. False if unknown.
  bool derivatives(Core& core, Matrix& by_q, Matrix& by_v, Vector& force);
  // Whether component k of u responds to the state, i.e. its motor is not at its limit.
  bool responds(Eigen::Index k) const { return !(is_direct() && is_at_limit(k)); }
  int limit_side(Eigen::Index k) const { return actuation_.limit_side(tau, k); }  // of a motor
  bool is_at_limit(Eigen::Index k) const { return limit_side(k) != 0; }
  bool is_direct() const { return actuation_.is_direct; }
  bool is_redundant() const { return actuation_.is_redundant(); }
  // whether motor torques are prescribed
  bool outputs_torques() const { return is_feedback() ? law->outputs_torques() : constant_is_torque; }
  // Whether u depends on the state between samples.
  bool is_feedback() const { return law && !sampling; }
  // Rate of the law's state where the control was computed last.
  bool law_rate(const MeasuredState& at, Out rate) { return law->state_rate(in_fixed_partition(at), rate, failure); }
  bool compute(const MeasuredState& at);
  // At an instant of the clock: take a sample that is due, and apply the outputs whose delay has elapsed.
  bool sample(const MeasuredState& at, bool& changed);
  void recover_u(Core& core);  // sets u, in the fixed partition, from prescribed motor torques
  double lyapunov(const MeasuredState& at, double potential_energy, In w);

 private:
  bool evaluate_law(const MeasuredState& at, Out u);
  bool evaluate_sample(const MeasuredState& at);  // sets sample_
  bool check_finite(In u);                        // stores u in `failure` if it is not finite
  MeasuredState in_fixed_partition(const MeasuredState& at);
  bool torque_derivatives(Core& core, Matrix& by_q, Matrix& by_v);
  bool limited_motor_derivatives(Core& core, Matrix& by_q, Matrix& by_v);
  Actuation actuation_;
  const Indices fixed_q_;  // q of the user's partition
  Vector sample_, requested_u_, requested_force_, q_, q_dot_, requested_;
  Vector law_rate_;
  Matrix u_by_q_, u_by_v_, to_fixed_q_;
};

}  // namespace ckc
