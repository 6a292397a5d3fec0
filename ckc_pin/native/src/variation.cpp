#include "variation.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/LU>

namespace ckc {

Variation::Variation(System& system, VariationTable table)
    : n(system.core.n),
      count(static_cast<int>(table.parameters.size())),
      system_(system),
      core_(system.core),
      table_(std::move(table)),
      tree_(table_.model, table_.place),
      derivatives_(tree_, table_.closure, table_.springs) {
  q_.setZero(tree_.nq), v_.setZero(tree_.n), a_.setZero(tree_.n);
  back_.setZero(n), delay_.setZero(count), acting_.setZero(n);
}

void Variation::compute(In v, In a, In lambda, bool impulsive) {
  for (size_t k = 0; k < table_.real_q.size(); ++k) q_(table_.real_q[k]) = core_.q_tree(static_cast<Eigen::Index>(k));
  for (int k = 0; k < n; ++k) v_(table_.real_v[k]) = v(k), a_(table_.real_v[k]) = a(k);
  derivatives_.compute(q_, v_, a_, lambda, impulsive);
}

void Variation::put(Out force, const Vector& of_tree) const {
  for (int k = 0; k < n; ++k) force(k) += of_tree(table_.real_v[k]);
}

// Joints give the motion of their bodies; what a change of inertia adds is linear in it.
void Variation::add_inertia(const Parameter& of, bool impulsive, Out force) const {
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
  Vector of_tree = Vector::Zero(tree_.n);
  for (int j : tree_.support[of.index]) of_tree(j) = wrench.dot(tree_.jacobian().col(j));
  put(force, of_tree);
}

void Variation::add_gravity(const Parameter& of, Out force) const {
  Vector6 falls = Vector6::Zero();
  falls.head<3>() = of.numbers;
  Vector of_tree = Vector::Zero(tree_.n);
  for (int joint = 1; joint < tree_.joints; ++joint) {
    const Vector6 wrench = tree_.spatial_inertia(joint) * falls;
    for (int j : tree_.support[joint]) of_tree(j) -= wrench.dot(tree_.jacobian().col(j));
  }
  put(force, of_tree);
}

void Variation::add_spring(const Parameter& of, Out force) const {
  const SpringTable& s = table_.springs;
  const auto count = static_cast<int>(s.stiffness.size()), in_a = s.point_joint[of.index], in_b = s.point_joint[count + of.index];
  const Carried a(tree_, in_a, s.point_local[of.index], true, changes_of(tree_, in_a));
  const Carried b(tree_, in_b, s.point_local[count + of.index], true, changes_of(tree_, in_b));
  const Vector3 r = a.x - b.x;
  const double length = r.norm();
  if (!(length > 0.0)) return;
  const double pull = of.kind == Parameter::stiffness     ? length - s.rest_length(of.index)
                      : of.kind == Parameter::rest_length ? -s.stiffness(of.index)
                                                          : r.dot(a.x_dot - b.x_dot) / length;
  Vector of_tree = Vector::Zero(tree_.n);
  for (const Carried* x : {&a, &b}) {
    const Indices& support = tree_.support[x->joint];
    const double sign = x == &a ? 1.0 : -1.0;
    for (size_t k = 0; k < support.size(); ++k) of_tree(support[k]) += sign * pull * r.dot(x->by_q.col(k)) / length;
  }
  put(force, of_tree);
}

// What each parameter does by way of a controller.
void Variation::add_control(In v, Matrix& force) const {
  if (!system_.control.feedback()) return;
  for (int p = 0; p < count; ++p) {
    const Parameter& of = table_.parameters[p];
    if (of.kind == Parameter::gain_q || of.kind == Parameter::gain_q_dot) add_gain(of, v, force.col(p));
    for (Eigen::Index i = 0; i < compensated_.rows(); ++i)
      if (system_.control.answers(i)) force(table_.own[i], p) -= compensated_(i, p);
  }
}

void Variation::add_gain(const Parameter& of, In v, Out force) const {
  const auto d = static_cast<Eigen::Index>(table_.own.size());
  const Eigen::Map<const Matrix> gain(of.numbers.data(), d, d);
  Vector seen(d);
  for (Eigen::Index k = 0; k < d; ++k)
    seen(k) = of.kind == Parameter::gain_q_dot ? v(table_.own[k])
                                               : core_.q_tree(core_.tree.place[table_.own[k]]) - of.numbers(d * d + k);
  seen = gain * seen;
  for (Eigen::Index k = 0; k < d; ++k)
    if (system_.control.answers(k)) force(table_.own[k]) += seen(k);
}

void Variation::add_parameters(In v, In lambda, bool impulsive, Matrix& force, Matrix& row) const {
  const SpringTable& s = table_.springs;
  const Joints& joints = core_.joints;
  for (int p = 0; p < count; ++p) {
    const Parameter& of = table_.parameters[p];
    const int k = of.index;
    switch (of.kind) {
      case Parameter::placement:
        put(force.col(p), derivatives_.force_by_q.col(k)), row.col(p) += derivatives_.row_by_q.col(k);
        break;
      case Parameter::inertia:
        add_inertia(of, impulsive, force.col(p));
        break;
      case Parameter::length:
        for (const Distance& distance : table_.closure.distances)
          if (distance.out == k)
            for (int j = 0; j < n; ++j) force(j, p) += lambda(k) / distance.length * derivatives_.J(k, table_.real_v[j]);
        break;
      default:
        break;
    }
    if (impulsive) continue;
    switch (of.kind) {
      case Parameter::gravity:
        add_gravity(of, force.col(p));
        break;
      case Parameter::stiffness:
      case Parameter::rest_length:
      case Parameter::damping:
        add_spring(of, force.col(p));
        break;
      case Parameter::joint_stiffness:
        force(k, p) += q_(tree_.place[table_.real_v[k]]) - s.joint_rest(table_.real_v[k]);
        break;
      case Parameter::joint_rest:
        force(k, p) -= s.joint_stiffness(table_.real_v[k]);
        break;
      case Parameter::joint_damping:
        force(k, p) += v(k);
        break;
      case Parameter::constant:
        force(k, p) -= 1.0;
        break;
      case Parameter::friction:
        force(k, p) += joints.smooth() ? std::tanh(v(k) / joints.table.smoothing) : joints.sign[k];
        break;
      default:
        break;
    }
  }
}

// How phi changes with the parameters where the whole tree was computed, and J v.
void Variation::closure_changes(Matrix& place, Matrix& rate) const {
  place.setZero(core_.rows.closure.rows, count), rate = place;
  for (int p = 0; p < count; ++p) {
    const Parameter& of = table_.parameters[p];
    if (of.kind == Parameter::placement)
      place.col(p) = derivatives_.J.col(of.index), rate.col(p) = derivatives_.rate_by_q.col(of.index);
    if (of.kind == Parameter::offset) place(of.index, p) = -1.0;
    if (of.kind == Parameter::length)
      for (const Distance& distance : table_.closure.distances)
        if (distance.out == of.index) place(of.index, p) = -1.0 - core_.rows.phi(of.index) / distance.length;
  }
}

// Move z so that J x is minus this.
void Variation::close(const Matrix& open, Matrix& x) {
  Vector step(n);
  for (int p = 0; p < count; ++p) {
    core_.z_step(open.col(p), step);
    x.col(p) += step;
  }
}

// At rest at the core's configuration: how what q has to be kept with changes, q's changes being given, and its stiffness.
void Variation::balance(Matrix& q, Matrix& effort, Matrix& stiffness) {
  const Vector none = Vector::Zero(n);
  Vector lambda = Vector::Zero(core_.rows.closure.rows), u(core_.d);
  core_.set_velocity(none), core_.bias(), core_.reduce();
  Vector lacking = core_.bias_tree;
  core_.reduced(lacking, u);
  for (int k = 0; k < core_.d; ++k) lacking(core_.q[k]) -= u(k);
  core_.multipliers(lacking, lambda);
  compute(none, none, lambda, false);
  Matrix place, rate;
  closure_changes(place, rate);
  close(core_.rows.J * q + place, q);
  force_.setZero(n, count), row_.setZero(core_.rows.closure.rows, count);
  add_parameters(none, lambda, false, force_, row_);
  Matrix by_q(n, n);
  for (int k = 0; k < n; ++k)
    for (int i = 0; i < n; ++i) by_q(i, k) = derivatives_.force_by_q(table_.real_v[i], table_.real_v[k]);
  effort = core_.rho.transpose() * (force_ + by_q * q);
  stiffness = core_.rho.transpose() * by_q * core_.rho;
}

// How the independent coordinates start is the parameters' to say; the others follow from the closure.
bool Variation::start(In v, Matrix& s) {
  const Vector here = core_.q_tree, none = Vector::Zero(n), no_force = Vector::Zero(core_.rows.closure.rows);
  s.setZero(2 * n, count);
  compensated_.setZero(core_.d, count);
  Matrix q = Matrix::Zero(n, count), effort, stiffness, place, rate;
  if (table_.target.size()) {
    core_.set(table_.target), core_.reduce();
    balance(q, compensated_, stiffness);
    q.setZero(), core_.set(here);
  }
  core_.reduce();
  if (core_.phi_z.singular()) return false;
  for (int p = 0; p < count; ++p)
    for (int k : core_.q) q(k, p) = table_.parameters[p].q(k);
  if (table_.at_equilibrium) {
    balance(q, effort, stiffness);
    q -= core_.rho * stiffness.partialPivLu().solve(effort);
  }
  compute(v, none, no_force, false);
  closure_changes(place, rate);
  if (!table_.at_equilibrium) close(core_.rows.J * q + place, q);
  s.topRows(n) = q;
  for (int k = 0; k < n; ++k) rate += derivatives_.rate_by_q.col(table_.real_v[k]) * q.row(k);
  Matrix change = Matrix::Zero(n, count);
  for (int p = 0; p < count; ++p)
    for (int k = 0; k < core_.d; ++k) change(core_.q[k], p) = table_.parameters[p].q_dot(k);
  close(core_.rows.J * change + rate, change);
  s.bottomRows(n) = change;
  return s.allFinite();
}

bool Variation::rates(In v, In a, const Matrix& s, Matrix& s_dot) {
  const int m = core_.rows.closure.rows;
  Joints& joints = core_.joints;
  if (!system_.control.slopes(core_, u_by_q_, u_by_v_, acting_)) return false;
  joints.add_friction(v, acting_);
  back_.setZero(), joints.add_slopes(v, back_);
  u_by_v_.diagonal() += back_;
  for (size_t i = 0; i < joints.locked.size(); ++i) acting_(joints.locked[i]) += joints.forces()(static_cast<Eigen::Index>(i));
  core_.set_velocity(v), core_.bias(), core_.tree_inertia();
  Vector lambda = Vector::Zero(m), lacking(n);
  core_.D_times(a, lacking);
  lacking += core_.bias_tree - core_.damping_tree - acting_;
  core_.multipliers(lacking, lambda);
  compute(v, a, lambda, false);
  force_.setZero(n, count), row_.setZero(m, count);
  add_parameters(v, lambda, false, force_, row_), add_control(v, force_);
  add_state(s);
  force_ = u_by_q_ * s.topRows(n) + u_by_v_ * s.bottomRows(n) - force_;
  if (!core_.respond(force_, row_, change_)) return false;
  if (!joints.locked.empty()) {
    if (!core_.responses(joints.locked, responses_)) return false;
    for (int p = 0; p < count; ++p) joints.back(responses_, change_.col(p), back_), change_.col(p) += back_;
  }
  move(v, s, s_dot);
  s_dot.bottomRows(n) = change_;
  return s_dot.allFinite();
}

void Variation::move(In v, const Matrix& s, Matrix& s_dot) const {
  s_dot.resize(2 * n, count);
  s_dot.topRows(n) = s.bottomRows(n);
  if (!core_.tree.roots.empty()) s_dot.topRows(n) -= core_.tree.brackets(v) * s.topRows(n);
}

void Variation::rates_of_start(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const {
  move(v, s, s_dot);
  s_dot.bottomRows(n).noalias() = by_q * s.topRows(n);
  s_dot.bottomRows(n).noalias() += by_v * s.bottomRows(n);
}

// What a change of the state adds to force_ and row_.
void Variation::add_state(const Matrix& s) {
  const Derivatives& by = derivatives_;
  for (int k = 0; k < n; ++k) {
    const int at = table_.real_v[k];
    row_ += by.row_by_q.col(at) * s.row(k) + by.row_by_v.col(at) * s.row(n + k);
    for (int i = 0; i < n; ++i)
      force_.row(i) += by.force_by_q(table_.real_v[i], at) * s.row(k) + by.force_by_v(table_.real_v[i], at) * s.row(n + k);
  }
}

}  // namespace ckc
