// Partial derivatives with respect to each parameter at one state: of the forces of eq. 1, of J a, and of phi.
#include <cmath>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

void Sensitivities::add_tree_force(Out force) const {
  for (int k = 0; k < n; ++k) force(k) += tree_force_(table_.real_v[k]);
}

// The inverse dynamics is linear in the inertia, so its derivative is the inverse dynamics of the inertia's change.
void Sensitivities::add_inertia(const ParameterDerivative& of, bool impulsive, Out force) {
  const Vector& x = of.numbers;
  const Matrix3 rotation = tree_.rotation(of.index);
  const Vector3 at = tree_.translation(of.index), first_moment = x.segment<3>(1);
  Matrix3 second_moment;
  second_moment << x(4), x(5), x(6), x(5), x(7), x(8), x(6), x(8), x(9);
  const auto local = [&](const Vector6& w, Vector3& linear, Vector3& angular) {
    const Vector3 omega_world = w.tail<3>();
    linear = rotation.transpose() * (w.head<3>() + omega_world.cross(at)), angular = rotation.transpose() * omega_world;
  };
  Vector3 v, omega, a, alpha;
  local(tree_.velocity(of.index), v, omega);
  local(tree_.acceleration(of.index) - (impulsive ? Vector6(Vector6::Zero()) : tree_.spatial_gravity()), a, alpha);
  const Vector3 p = x(0) * v + omega.cross(first_moment), l = second_moment * omega + first_moment.cross(v);
  const Vector3 f = rotation * (x(0) * a + alpha.cross(first_moment) + omega.cross(p));
  const Vector3 torque =
      rotation * (second_moment * alpha + first_moment.cross(a) + omega.cross(l) + v.cross(p)) + at.cross(f);
  Vector6 wrench;
  wrench << f, torque;
  tree_force_.setZero();
  for (int j : tree_.support[of.index]) tree_force_(j) = wrench.dot(tree_.jacobian().col(j));
  add_tree_force(force);
}

void Sensitivities::add_gravity(const ParameterDerivative& of, Out force) {
  Vector6 gravity = Vector6::Zero();
  gravity.head<3>() = of.numbers;
  tree_force_.setZero();
  for (int joint = 1; joint < tree_.joints; ++joint) {
    const Vector6 wrench = tree_.spatial_inertia(joint) * gravity;
    for (int j : tree_.support[joint]) tree_force_(j) -= wrench.dot(tree_.jacobian().col(j));
  }
  add_tree_force(force);
}

void Sensitivities::add_spring(const ParameterDerivative& of, Out force) {
  const SpringTable& s = table_.springs;
  const AttachedVector &a = derivatives_.spring_end_a(of.index), &b = derivatives_.spring_end_b(of.index);
  const Vector3 r = a.x - b.x;
  const double length = r.norm();
  if (!(length > 0.0)) return;
  const double pull = of.kind == ParameterDerivative::stiffness     ? length - s.rest_length(of.index)
                      : of.kind == ParameterDerivative::rest_length ? -s.stiffness(of.index)
                                                                    : r.dot(a.x_dot - b.x_dot) / length;
  tree_force_.setZero();
  for (const AttachedVector* x : {&a, &b}) {
    const Indices& support = tree_.support[x->joint];
    const double sign = x == &a ? 1.0 : -1.0;
    for (size_t k = 0; k < support.size(); ++k)
      tree_force_(support[k]) += sign * pull * r.dot(x->by_q.col(static_cast<Eigen::Index>(k))) / length;
  }
  add_tree_force(force);
}

void Sensitivities::add_parameters(In v, In a, In lambda, bool impulsive, Matrix& force, Matrix& row) {
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives) {
      add_term_derivative(of, a, lambda, impulsive, force.col(p), row.col(p));
      if (!impulsive) add_force_derivative(of, v, force.col(p));
    }
}

// Derivatives of D'a - J^T lambda and of J a, including inertial forces.
void Sensitivities::add_term_derivative(const ParameterDerivative& of, In a, In lambda, bool impulsive, Out force,
                                        Out row) {
  const int k = of.index;
  switch (of.kind) {
    case ParameterDerivative::placement:
      for (int i = 0; i < n; ++i) force(i) += of.numbers(0) * derivatives_.force_by_q(table_.real_v[i], k);
      row += of.numbers(0) * derivatives_.row_by_q.col(k);
      break;
    case ParameterDerivative::inertia: add_inertia(of, impulsive, force); break;
    case ParameterDerivative::armature: force(k) += of.numbers(0) * a(k); break;
    case ParameterDerivative::rotors: force(k) += of.numbers.dot(a); break;
    case ParameterDerivative::coefficient: {
      const int coordinate = static_cast<int>(of.numbers(0));
      force(coordinate) -= of.numbers(1) * lambda(k), row(k) += of.numbers(1) * a(coordinate);
      break;
    }
    case ParameterDerivative::length:
      for (const Distance& distance : table_.closure.distances)
        if (distance.out == k)
          for (int j = 0; j < n; ++j) force(j) += lambda(k) / distance.length * derivatives_.J(k, table_.real_v[j]);
      break;
    default: break;
  }
}

void Sensitivities::add_force_derivative(const ParameterDerivative& of, In v, Out force) {
  const SpringTable& s = table_.springs;
  const int k = of.index;
  switch (of.kind) {
    case ParameterDerivative::gravity: add_gravity(of, force); break;
    case ParameterDerivative::stiffness:
    case ParameterDerivative::rest_length:
    case ParameterDerivative::damping: add_spring(of, force); break;
    case ParameterDerivative::joint_stiffness:
      force(k) += q_(tree_.q_index[table_.real_v[k]]) - s.joint_rest(table_.real_v[k]);
      break;
    case ParameterDerivative::joint_rest: force(k) -= s.joint_stiffness(table_.real_v[k]); break;
    case ParameterDerivative::joint_damping: force(k) += v(k); break;
    case ParameterDerivative::constant: force(k) -= 1.0; break;
    default: break;
  }
}

// Derivatives of friction, motor and controller forces, with the sign of the residual force.
void Sensitivities::add_applied_derivatives(In q_tree, In v, Matrix& force) {
  const Joints& joints = core_.joints;
  const double smoothing = joints.table.smoothing;
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives)
      if (of.kind == ParameterDerivative::friction)
        force(of.index, p) += smoothing > 0.0 ? std::tanh(v(of.index) / smoothing) : joints.sliding_direction[of.index];
  add_control_derivatives(q_tree, v, force);
}

void Sensitivities::add_control_derivatives(In q_tree, In v, Matrix& force) {
  const Control& control = system_.control;
  const bool motors_are_limited = limited_tau_.size() > 0;
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives) {
      const int k = of.index;
      if (of.kind != ParameterDerivative::gear && of.kind != ParameterDerivative::torque_limit) continue;
      const bool limited = control.is_at_limit(k);
      if (!control.outputs_torques() && !motors_are_limited && !(control.is_direct() && limited)) continue;
      if (of.kind == ParameterDerivative::gear)
        force.col(p) -= control.tau(k) * of.numbers;
      else if (limited)
        force.col(p) -= limited_torque_derivative(of) * table_.transmission.row(k).transpose();
    }
  if (motors_are_limited)
    force.noalias() -= table_.transmission.transpose() * limited_tau_;
  else
    add_requested_u(q_tree, v, force);
}

const Matrix& Sensitivities::requested_u_derivative(In q_tree, In v) {
  requested_u_ = compensation_;
  if (gains_.empty()) return requested_u_;
  for (size_t i = 0; i < table_.fixed_q.size(); ++i) {
    const auto k = static_cast<Eigen::Index>(i);
    fixed_q_(k) = q_tree(core_.tree.q_index[table_.fixed_q[i]]), fixed_q_dot_(k) = v(table_.fixed_q[i]);
  }
  for (const Gain& gain : gains_) {
    system_.control.law->gain_derivative({0.0, core_, fixed_q_, fixed_q_dot_, core_.v_tree, fixed_q_dot_}, gain.of_q,
                                         gain.of_q_dot, u_derivative_);
    requested_u_.col(gain.parameter) += u_derivative_;
  }
  return requested_u_;
}

void Sensitivities::add_requested_u(In q_tree, In v, Matrix& force) {
  if (!system_.control.is_feedback() && !has_held_output()) return;
  const Matrix& u = system_.control.is_feedback() ? requested_u_derivative(q_tree, v) : held_output_;
  for (Eigen::Index i = 0; i < u.rows(); ++i)
    if (system_.control.responds(i)) force.row(table_.fixed_q[i]) -= u.row(i);
}

bool Sensitivities::control_sampled(const Matrix& s, const Sampling& clock, bool& changed) {
  if (clock.samples_taken) {
    const auto d = static_cast<Eigen::Index>(table_.fixed_q.size());
    Matrix by_q = Matrix::Zero(d, n), by_v = by_q;
    if (!system_.control.law->derivatives(core_, table_.fixed_q, by_q, by_v)) return false;
    queued_.push_back(requested_u_derivative(core_.q_tree, system_.velocity) + by_q * s.topRows(n) +
                      by_v * s.bottomRows(n));
  }
  for (int k = 0; k < clock.outputs_applied; ++k) {
    // even if u itself is unchanged
    changed |= held_output_.size() != queued_.front().size() || held_output_ != queued_.front();
    held_output_ = queued_.front(), queued_.pop_front();
  }
  return true;
}

// Derivatives of phi and of J v; requires `compute`.
void Sensitivities::closure_derivatives(In v, Matrix& phi_derivative, Matrix& phi_dot_derivative) const {
  phi_derivative.setZero(core_.constraints.closure.rows, count), phi_dot_derivative = phi_derivative;
  for (int p = 0; p < count; ++p)
    for (const ParameterDerivative& of : table_.parameters[p].derivatives) {
      if (of.kind == ParameterDerivative::placement) {
        phi_derivative.col(p) += of.numbers(0) * derivatives_.J.col(of.index);
        phi_dot_derivative.col(p) += of.numbers(0) * derivatives_.rate_by_q.col(of.index);
      } else if (of.kind == ParameterDerivative::offset) {
        phi_derivative(of.index, p) -= 1.0;
      } else if (of.kind == ParameterDerivative::coefficient) {
        const int coordinate = static_cast<int>(of.numbers(0));
        phi_derivative(of.index, p) += of.numbers(1) * core_.q_tree(core_.tree.q_index[coordinate]),
            phi_dot_derivative(of.index, p) += of.numbers(1) * v(coordinate);
      } else if (of.kind == ParameterDerivative::length) {
        for (const Distance& distance : table_.closure.distances)
          if (distance.out == of.index)
            phi_derivative(of.index, p) -= 1.0 + core_.constraints.phi(of.index) / distance.length;
      }
    }
}

Vector Sensitivities::distance_from_stop_derivative(const JointArrival& arrival, const Matrix& s) const {
  Vector distance(count);
  for (int p = 0; p < count; ++p) {
    distance(p) = core_.tree.coordinate_change(core_.q_tree, arrival.coordinate, s.col(p));
    for (const ParameterDerivative& of : table_.parameters[p].derivatives)
      if (arrival.stop && of.index == arrival.coordinate &&
          of.kind == (arrival.stop < 0 ? ParameterDerivative::lower : ParameterDerivative::upper))
        distance(p) -= 1.0;
  }
  return distance;
}

}  // namespace ckc
