// What each parameter does at a state: to the forces of eq. 1, to J a, and to where the loops close.
#include <cmath>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

void Variation::put(Out force) const {
  for (int k = 0; k < n; ++k) force(k) += of_tree_(table_.real_v[k]);
}

// Joints give the motion of their bodies; what a change of inertia adds is linear in it.
void Variation::add_inertia(const Effect& of, bool impulsive, Out force) {
  const Vector& x = of.numbers;
  const Matrix3 turn = tree_.rotation(of.index);
  const Vector3 at = tree_.translation(of.index), moment = x.segment<3>(1);
  Matrix3 about;
  about << x(4), x(5), x(6), x(5), x(7), x(8), x(6), x(8), x(9);
  const auto local = [&](const Vector6& w, Vector3& move, Vector3& spin) {
    const Vector3 of_spin = w.tail<3>();
    move = turn.transpose() * (w.head<3>() + of_spin.cross(at)), spin = turn.transpose() * of_spin;
  };
  Vector3 v, omega, a, alpha;
  local(tree_.motion(of.index), v, omega);
  local(tree_.motion_rate(of.index) - (impulsive ? Vector6(Vector6::Zero()) : tree_.field()), a, alpha);
  const Vector3 p = x(0) * v + omega.cross(moment), l = about * omega + moment.cross(v);
  const Vector3 f = turn * (x(0) * a + alpha.cross(moment) + omega.cross(p));
  const Vector3 torque = turn * (about * alpha + moment.cross(a) + omega.cross(l) + v.cross(p)) + at.cross(f);
  Vector6 wrench;
  wrench << f, torque;
  of_tree_.setZero();
  for (int j : tree_.support[of.index]) of_tree_(j) = wrench.dot(tree_.jacobian().col(j));
  put(force);
}

void Variation::add_gravity(const Effect& of, Out force) {
  Vector6 falls = Vector6::Zero();
  falls.head<3>() = of.numbers;
  of_tree_.setZero();
  for (int joint = 1; joint < tree_.joints; ++joint) {
    const Vector6 wrench = tree_.spatial_inertia(joint) * falls;
    for (int j : tree_.support[joint]) of_tree_(j) -= wrench.dot(tree_.jacobian().col(j));
  }
  put(force);
}

void Variation::add_spring(const Effect& of, Out force) {
  const SpringTable& s = table_.springs;
  const Carried &a = derivatives_.end_a(of.index), &b = derivatives_.end_b(of.index);
  const Vector3 r = a.x - b.x;
  const double length = r.norm();
  if (!(length > 0.0)) return;
  const double pull = of.kind == Effect::stiffness     ? length - s.rest_length(of.index)
                      : of.kind == Effect::rest_length ? -s.stiffness(of.index)
                                                       : r.dot(a.x_dot - b.x_dot) / length;
  of_tree_.setZero();
  for (const Carried* x : {&a, &b}) {
    const Indices& support = tree_.support[x->joint];
    const double sign = x == &a ? 1.0 : -1.0;
    for (size_t k = 0; k < support.size(); ++k)
      of_tree_(support[k]) += sign * pull * r.dot(x->by_q.col(static_cast<Eigen::Index>(k))) / length;
  }
  put(force);
}

void Variation::add_parameters(In v, In a, In lambda, bool impulsive, Matrix& force, Matrix& row) {
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects) {
      add_effect(of, a, lambda, impulsive, force.col(p), row.col(p));
      if (!impulsive) add_force(of, v, force.col(p));
    }
}

// Of D'a - J^T lambda and of J a, and what goes with an inertia.
void Variation::add_effect(const Effect& of, In a, In lambda, bool impulsive, Out force, Out row) {
  const int k = of.index;
  switch (of.kind) {
    case Effect::placement:
      for (int i = 0; i < n; ++i) force(i) += of.numbers(0) * derivatives_.force_by_q(table_.real_v[i], k);
      row += of.numbers(0) * derivatives_.row_by_q.col(k);
      break;
    case Effect::inertia:
      add_inertia(of, impulsive, force);
      break;
    case Effect::armature:
      force(k) += of.numbers(0) * a(k);
      break;
    case Effect::ratio: {
      const int other = static_cast<int>(of.numbers(0));
      force(other) += lambda(k), row(k) -= a(other);
      break;
    }
    case Effect::length:
      for (const Distance& distance : table_.closure.distances)
        if (distance.out == k)
          for (int j = 0; j < n; ++j) force(j) += lambda(k) / distance.length * derivatives_.J(k, table_.real_v[j]);
      break;
    default:
      break;
  }
}

void Variation::add_force(const Effect& of, In v, Out force) {
  const SpringTable& s = table_.springs;
  const int k = of.index;
  switch (of.kind) {
    case Effect::gravity:
      add_gravity(of, force);
      break;
    case Effect::stiffness:
    case Effect::rest_length:
    case Effect::damping:
      add_spring(of, force);
      break;
    case Effect::joint_stiffness:
      force(k) += q_(tree_.place[table_.real_v[k]]) - s.joint_rest(table_.real_v[k]);
      break;
    case Effect::joint_rest:
      force(k) -= s.joint_stiffness(table_.real_v[k]);
      break;
    case Effect::joint_damping:
      force(k) += v(k);
      break;
    case Effect::constant:
      force(k) -= 1.0;
      break;
    default:
      break;
  }
}

// What each parameter does by way of friction, of motors and of a controller, with the sign of what is lacking.
void Variation::add_acting(In q_tree, In v, Matrix& force) {
  const Joints& joints = core_.joints;
  const double smoothing = joints.table.smoothing;
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects)
      if (of.kind == Effect::friction)
        force(of.index, p) += smoothing > 0.0 ? std::tanh(v(of.index) / smoothing) : joints.sign[of.index];
  add_control(q_tree, v, force);
}

void Variation::add_control(In q_tree, In v, Matrix& force) {
  const Control& control = system_.control;
  const bool clipped = clipped_.size() > 0;
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects) {
      const int k = of.index;
      if (of.kind != Effect::gear && of.kind != Effect::torque_limit) continue;
      const bool limited = control.limited(k);
      if (!control.of_motors() && !clipped && !(control.direct() && limited)) continue;
      if (of.kind == Effect::gear)
        force.col(p) -= control.tau(k) * of.numbers;
      else if (limited)
        force.col(p) -= limit(k) * of.numbers;
    }
  if (clipped)
    force.noalias() -= table_.turns.transpose() * clipped_;
  else
    add_wanted(q_tree, v, force);
}

const Matrix& Variation::wanted(In q_tree, In v) {
  wanted_ = compensated_;
  if (gains_.empty()) return wanted_;
  for (size_t i = 0; i < table_.own.size(); ++i) {
    const auto k = static_cast<Eigen::Index>(i);
    q_own_(k) = q_tree(core_.tree.place[table_.own[i]]), q_dot_own_(k) = v(table_.own[i]);
  }
  for (const Gain& gain : gains_) {
    system_.control.law->by_gains({0.0, core_, q_own_, q_dot_own_, core_.v_tree, q_dot_own_}, gain.of_q, gain.of_q_dot, more_);
    wanted_.col(gain.parameter) += more_;
  }
  return wanted_;
}

void Variation::add_wanted(In q_tree, In v, Matrix& force) {
  if (!system_.control.feedback() && !holds()) return;
  const Matrix& u = system_.control.feedback() ? wanted(q_tree, v) : held_;
  for (Eigen::Index i = 0; i < u.rows(); ++i)
    if (system_.control.answers(i)) force.row(table_.own[i]) -= u.row(i);
}

bool Variation::sampled(const Matrix& s, const Sampling& clock, bool& changed) {
  if (clock.taken) {
    const auto d = static_cast<Eigen::Index>(table_.own.size());
    Matrix by_q = Matrix::Zero(d, n), by_v = by_q;
    if (!system_.control.law->slopes(core_, table_.own, by_q, by_v)) return false;
    waiting_.push_back(wanted(core_.q_tree, system_.velocity) + by_q * s.topRows(n) + by_v * s.bottomRows(n));
  }
  for (int k = 0; k < clock.acted; ++k) {
    changed |= held_.size() != waiting_.front().size() || held_ != waiting_.front();  // though u may be what it was
    held_ = waiting_.front(), waiting_.pop_front();
  }
  return true;
}

// How phi changes with the parameters where the whole tree was computed, and J v.
void Variation::closure_changes(In v, Matrix& place, Matrix& rate) const {
  place.setZero(core_.rows.closure.rows, count), rate = place;
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects) {
      if (of.kind == Effect::placement) {
        place.col(p) += of.numbers(0) * derivatives_.J.col(of.index);
        rate.col(p) += of.numbers(0) * derivatives_.rate_by_q.col(of.index);
      } else if (of.kind == Effect::offset) {
        place(of.index, p) -= 1.0;
      } else if (of.kind == Effect::ratio) {
        const int other = static_cast<int>(of.numbers(0));
        place(of.index, p) -= core_.q_tree(core_.tree.place[other]), rate(of.index, p) -= v(other);
      } else if (of.kind == Effect::length) {
        for (const Distance& distance : table_.closure.distances)
          if (distance.out == of.index) place(of.index, p) -= 1.0 + core_.rows.phi(of.index) / distance.length;
      }
    }
}

Vector Variation::from_stop(const System::Met& met, const Matrix& s) const {
  Vector found(count);
  for (int p = 0; p < count; ++p) {
    found(p) = core_.tree.coordinate_step(core_.q_tree, met.coordinate, s.col(p));
    for (const Effect& of : table_.parameters[p].effects)
      if (met.stop && of.index == met.coordinate && of.kind == (met.stop < 0 ? Effect::lower : Effect::upper))
        found(p) -= 1.0;
  }
  return found;
}

}  // namespace ckc
