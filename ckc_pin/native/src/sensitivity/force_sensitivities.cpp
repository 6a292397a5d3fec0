// Sensitivities of controls and motor torques.
#include <limits>

#include <Eigen/LU>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

// Eq. 6's force u on q is equivalent to the force f on the tree: f + J^T lambda = E u, where E selects the user's q.
// With R = rho in those coordinates, du = R^T (df + d(J^T) lambda). For motors, f = T^T tau.
void Sensitivities::force_sensitivities(In v, const Matrix& s, Matrix& u, Matrix& tau) {
  const Control& control = system_.control;
  const auto d = static_cast<Eigen::Index>(table_.fixed_q.size()), motors = table_.transmission.rows();
  bool outputs_torques = control.outputs_torques();
  u.setZero(d, count), tau.setZero(motors, count);
  if (!control.is_active()) return;
  gear_force_.setZero(n, count);
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives) {
      if (of.kind == ParameterDerivative::gear) gear_force_.col(p) += control.tau(of.index) * of.numbers;
      if (of.kind == ParameterDerivative::torque_limit) tau(of.index, p) += limited_torque_derivative(of);
    }
  if (!outputs_torques) {
    if (!system_.control.derivatives(core_, u_by_q_, u_by_v_, applied_force_)) {
      u.setConstant(std::numeric_limits<double>::quiet_NaN()), tau = Matrix::Constant(motors, count, u(0, 0));
      return;
    }
    if (control.limited_motors.exist) {
      limited_motor_sensitivities(v);
      tau += limited_tau_ + control.limited_motors.by_q * s.topRows(n) + control.limited_motors.by_v * s.bottomRows(n);
      outputs_torques = true;
    }
  }
  if (!outputs_torques) {
    limited_tau_.resize(0, 0), force_.setZero();
    add_control_derivatives(core_.q_tree, v, force_);
    force_ = -force_, add_feedback(s);
    for (Eigen::Index i = 0; i < d; ++i) u.row(i) = force_.row(table_.fixed_q[i]);
    if (control.is_direct()) {
      for (Eigen::Index i = 0; i < d; ++i) tau.row(i) = u.row(i) - gear_force_.row(table_.fixed_q[i]);
      return;
    }
  }
  core_.compute_rho();
  Matrix fixed_rho(d, core_.d);
  for (Eigen::Index i = 0; i < d; ++i) fixed_rho.row(i) = core_.rho.row(table_.fixed_q[i]);
  const Matrix basis = core_.rho * fixed_rho.partialPivLu().inverse();
  residual_force_ = -control.u_tree;
  for (Eigen::Index i = 0; i < d; ++i) residual_force_(table_.fixed_q[i]) += control.u(i);
  core_.minimum_norm_multipliers(residual_force_, lambda_);
  const Vector none = Vector::Zero(n);
  compute(none, none, lambda_, true);
  force_.setZero(), row_.setZero();
  add_parameters(none, none, lambda_, true, force_, row_);
  Matrix positions = s;
  positions.bottomRows(n).setZero();
  add_state_derivatives(positions);
  const Matrix parameter_force = basis.transpose() * (gear_force_ - force_),
               transmission = basis.transpose() * table_.transmission.transpose();
  if (outputs_torques)
    u = parameter_force + transmission * tau;
  else if (motors == d)
    tau = transmission.partialPivLu().solve(u - parameter_force);
  else
    // the allocation among redundant motors has no unique derivative
    tau.setConstant(std::numeric_limits<double>::quiet_NaN());
}

// Derivative of the requested u, minus that of the motor forces without limits (control/control.cpp).
void Sensitivities::limited_motor_sensitivities(In v) {
  const Control& control = system_.control;
  const Vector none = Vector::Zero(n);
  compute(none, none, control.limited_motors.lambda, true);
  force_.setZero(n, count), row_.setZero(core_.constraints.closure.rows, count);
  add_parameters(none, none, control.limited_motors.lambda, true, force_, row_);
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives)
      if (of.kind == ParameterDerivative::gear) force_.col(p) -= control.limited_motors.tau(of.index) * of.numbers;
  Matrix requested_u_derivative = Matrix::Zero(n, count), u = core_.rho.transpose() * force_;
  add_requested_u(core_.q_tree, v, requested_u_derivative);
  for (Eigen::Index i = 0; i < u.rows(); ++i) u.row(i) -= requested_u_derivative.row(table_.fixed_q[i]);
  limited_tau_ = control.limited_motors.response * u;
}

}  // namespace ckc
