// How what a controller and motors do changes with parameters.
#include <limits>

#include <Eigen/LU>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

// Eq. 6's force u does on q alone what u' = f does on the tree: f + J^T lambda = E u with E of the user's own q, so that
// with R = rho in those coordinates du = R^T (df + d(J^T) lambda). f is T^T tau of the motors.
void Variation::efforts(In v, const Matrix& s, Matrix& u, Matrix& tau) {
  const Control& control = system_.control;
  const auto d = static_cast<Eigen::Index>(table_.own.size()), motors = table_.turns.rows();
  bool torques = control.of_motors();
  u.setZero(d, count), tau.setZero(motors, count);
  if (!control.acts()) return;
  geared_.setZero(n, count);
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects) {
      if (of.kind == Effect::gear) geared_.col(p) += control.tau(of.index) * of.numbers;
      if (of.kind == Effect::torque_limit) tau(of.index, p) += limit(of.index);
    }
  if (!torques) {
    if (!system_.control.slopes(core_, u_by_q_, u_by_v_, acting_)) {
      u.setConstant(std::numeric_limits<double>::quiet_NaN()), tau = Matrix::Constant(motors, count, u(0, 0));
      return;
    }
    if (control.clipped.any) {
      clipped_efforts(v);
      tau += clipped_ + control.clipped.by_q * s.topRows(n) + control.clipped.by_v * s.bottomRows(n);
      torques = true;
    }
  }
  if (!torques) {
    clipped_.resize(0, 0), force_.setZero();
    add_control(core_.q_tree, v, force_);
    force_ = -force_, add_answer(s);
    for (Eigen::Index i = 0; i < d; ++i) u.row(i) = force_.row(table_.own[i]);
    if (control.direct()) {
      for (Eigen::Index i = 0; i < d; ++i) tau.row(i) = u.row(i) - geared_.row(table_.own[i]);
      return;
    }
  }
  core_.reduce();
  Matrix own(d, core_.d);
  for (Eigen::Index i = 0; i < d; ++i) own.row(i) = core_.rho.row(table_.own[i]);
  const Matrix basis = core_.rho * own.partialPivLu().inverse();
  lacking_ = -control.u_tree;
  for (Eigen::Index i = 0; i < d; ++i) lacking_(table_.own[i]) += control.u(i);
  core_.multipliers(lacking_, lambda_);
  const Vector none = Vector::Zero(n);
  compute(none, none, lambda_, true);
  force_.setZero(), row_.setZero();
  add_parameters(none, none, lambda_, true, force_, row_);
  Matrix places = s;
  places.bottomRows(n).setZero();
  add_state(places);
  const Matrix turned = basis.transpose() * (geared_ - force_), transmission = basis.transpose() * table_.turns.transpose();
  if (torques)
    u = turned + transmission * tau;
  else if (motors == d)
    tau = transmission.partialPivLu().solve(u - turned);
  else
    tau.setConstant(std::numeric_limits<double>::quiet_NaN());  // which of them, when they share u, is not known
}

// du of what is wanted, less what the parameters make of what the motors would do without limits (control/control.cpp).
void Variation::clipped_efforts(In v) {
  const Control& control = system_.control;
  const Vector none = Vector::Zero(n);
  compute(none, none, control.clipped.lambda, true);
  force_.setZero(n, count), row_.setZero(core_.rows.closure.rows, count);
  add_parameters(none, none, control.clipped.lambda, true, force_, row_);
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects)
      if (of.kind == Effect::gear) force_.col(p) -= control.clipped.tau(of.index) * of.numbers;
  Matrix wanted = Matrix::Zero(n, count), u = core_.rho.transpose() * force_;
  add_wanted(core_.q_tree, v, wanted);
  for (Eigen::Index i = 0; i < u.rows(); ++i) u.row(i) -= wanted.row(table_.own[i]);
  clipped_ = control.clipped.answer * u;
}

}  // namespace ckc
