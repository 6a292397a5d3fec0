#include "control/joint_servo.hpp"

#include <algorithm>

namespace ckc {

JointServo::JointServo(std::vector<Servo> servos, std::unique_ptr<Trajectory> desired,
                       std::unique_ptr<Actuation> gravity)
    : servos_(std::move(servos)), desired_(std::move(desired)), gravity_(std::move(gravity)) {
  Eigen::Index integrals = 0;
  for (const Servo& servo : servos_) integral_.push_back(servo.K_I != 0.0 ? integrals++ : -1);
  for (Vector* x : {&value_, &rate_, &acceleration_, &error_, &requested_})
    x->setZero(static_cast<Eigen::Index>(servos_.size()));
}

Vector JointServo::initial_state() const {
  return Vector::Zero(std::count_if(integral_.begin(), integral_.end(), [](auto at) { return at >= 0; }));
}

bool JointServo::compute_u(const MeasuredState& at, Out tau, ControlFailure& failure) {
  if (!(*desired_)(at.t, value_, rate_, acceleration_)) return failure.message = desired_->failure, false;
  tau.setZero();
  if (gravity_) {
    Core& core = at.core;
    core.compute_rho();
    core.set_velocity(at.v_tree), core.compute_coriolis();
    h_.resize(core.d), gravity_tau_.resize(tau.size()), gravity_force_.resize(core.n);
    core.multiply_rho_transposed(core.h_tree, h_);
    gravity_->allocate(core, h_, gravity_tau_, gravity_force_);
    tau = gravity_tau_;
  }
  for (size_t i = 0; i < servos_.size(); ++i) {
    const Servo& servo = servos_[i];
    const auto k = static_cast<Eigen::Index>(i);
    const double rate_error = at.v_tree(servo.joint) - rate_(k);
    error_(k) = servo.of_rate ? rate_error : at.core.q_tree(at.core.tree.q_index[servo.joint]) - value_(k);
    double force = -servo.K_P * error_(k);
    if (!servo.of_rate) force -= servo.K_D * rate_error;
    if (integral_[i] >= 0) force += state(integral_[i]);
    tau(servo.motor) += force / servo.gear;
    requested_(k) = tau(servo.motor);
  }
  return true;
}

bool JointServo::state_rate(const MeasuredState&, Out rate, ControlFailure&) {
  for (size_t i = 0; i < servos_.size(); ++i) {
    if (integral_[i] < 0) continue;
    const Servo& servo = servos_[i];
    const auto k = static_cast<Eigen::Index>(i);
    const double excess = requested_(k) - std::clamp(requested_(k), servo.lower, servo.upper);
    rate(integral_[i]) = -servo.K_I * error_(k) - servo.unwinding * servo.gear * excess;
  }
  return true;
}

bool JointServo::derivatives(Core&, const Indices&, Matrix& by_q, Matrix& by_v) {
  if (gravity_) return false;  // those of h are not computed
  for (const Servo& servo : servos_) {
    by_q(servo.motor, servo.joint) = servo.of_rate ? 0.0 : -servo.K_P / servo.gear;
    by_v(servo.motor, servo.joint) = -(servo.of_rate ? servo.K_P : servo.K_D) / servo.gear;
  }
  return true;
}

}  // namespace ckc
