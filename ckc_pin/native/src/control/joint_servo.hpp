// P, PI, PD and PID control of single joints by their motors.
#pragma once

#include "control/control.hpp"

namespace ckc {

struct Servo {
  int motor, joint;
  double gear;           // shaft rate by joint rate
  bool of_rate;          // velocity mode: the error is that of the rate, and K_D does not act
  double K_P, K_I, K_D;  // at the joint
  double lower, upper;   // limits of the motor's torque
  double unwinding;      // 1/s: rate at which the integral follows a torque at its limit
};

// Torque of the joint: x - K_P e - K_D e_dot, with the integral x_dot = -K_I e. At a torque limit x is driven to where the
// request equals the limit (back-calculation). With `gravity`, the torques that balance h are added. Other motors have
// none.
class JointServo : public Controller {
 public:
  // `desired`: of the joints, in the order of the servos. `gravity`: the allocation of h to the motors.
  JointServo(std::vector<Servo> servos, std::unique_ptr<Trajectory> desired, std::unique_ptr<Actuation> gravity);
  bool compute_u(const MeasuredState& at, Out tau, ControlFailure& failure) override;
  bool outputs_torques() const override { return true; }
  Vector initial_state() const override;
  bool state_rate(const MeasuredState& at, Out rate, ControlFailure& failure) override;
  void set_segment(double begin, double end, double tolerance) override {
    desired_->set_segment(begin, end, tolerance);
  }
  bool needs_fixed_partition() const override { return false; }
  bool derivatives(Core& core, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) override;

 private:
  std::vector<Servo> servos_;
  std::unique_ptr<Trajectory> desired_;
  std::unique_ptr<Actuation> gravity_;
  std::vector<Eigen::Index> integral_;  // by servo: its entry of the state, -1 without K_I
  Vector value_, rate_, acceleration_;  // desired
  Vector error_, requested_;            // of the last output, by servo
  Vector h_, gravity_tau_, gravity_force_;
};

}  // namespace ckc
