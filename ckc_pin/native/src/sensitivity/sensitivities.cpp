#include "sensitivity/sensitivities.hpp"

#include <algorithm>

#include <Eigen/LU>

#include "loops/compiled_terms.hpp"

namespace ckc {

constexpr double neutral = 1e-12;  // of its largest: a stiffness that keeps nothing

static bool is_acting(const Effect& of) {
  return of.kind == Effect::friction || of.kind == Effect::gain_q || of.kind == Effect::gain_q_dot ||
         of.kind == Effect::target || of.kind == Effect::gear || of.kind == Effect::torque_limit;
}

Variation::Variation(System& system, VariationTable table)
    : n(system.core.n),
      count(static_cast<int>(table.parameters.size())),
      system_(system),
      core_(system.core),
      table_(std::move(table)),
      tree_(table_.model, table_.place),
      derivatives_(tree_, table_.closure, table_.springs) {
  const int m = core_.rows.closure.rows;
  q_.setZero(tree_.nq), v_.setZero(tree_.n), a_.setZero(tree_.n), of_tree_.setZero(tree_.n);
  delay_.setZero(1 + *std::max_element(table_.part.begin(), table_.part.end()), count), largest_.setZero(count);
  back_.setZero(n), acting_.setZero(n), lacking_.setZero(n), lambda_.setZero(m);
  force_.setZero(n, count), row_.setZero(m, count), change_.setZero(n, count);
  for (const Parameter& of : table_.parameters)
    acting_varies_ |= std::any_of(of.effects.begin(), of.effects.end(), is_acting);
  const auto d = static_cast<Eigen::Index>(table_.own.size());
  for (Vector* x : {&q_own_, &q_dot_own_, &more_}) x->setZero(d);
  for (int p = 0; p < count; ++p)
    for (const Effect& of : table_.parameters[p].effects) {
      if (of.kind != Effect::gain_q && of.kind != Effect::gain_q_dot) continue;
      const Matrix gain = of.numbers.reshaped(d, d), none = Matrix::Zero(d, d);
      gains_.push_back(of.kind == Effect::gain_q ? Gain{p, gain, none} : Gain{p, none, gain});
    }
}

void Variation::compute(In v, In a, In lambda, bool impulsive) {
  for (size_t k = 0; k < table_.real_q.size(); ++k) q_(table_.real_q[k]) = core_.q_tree(static_cast<Eigen::Index>(k));
  for (int k = 0; k < n; ++k) v_(table_.real_v[k]) = v(k), a_(table_.real_v[k]) = a(k);
  derivatives_.compute(q_, v_, a_, lambda, impulsive);
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
  closure_changes(none, place, rate);
  close(core_.rows.J * q + place, q);
  force_.setZero(n, count), row_.setZero(core_.rows.closure.rows, count);
  add_parameters(none, none, lambda, false, force_, row_);
  Matrix by_q(n, n);
  for (int k = 0; k < n; ++k)
    for (int i = 0; i < n; ++i) by_q(i, k) = derivatives_.force_by_q(table_.real_v[i], table_.real_v[k]);
  effort = core_.rho.transpose() * (force_ + by_q * q);
  stiffness = core_.rho.transpose() * by_q * core_.rho;
}

// How the independent coordinates start is the parameters' to say; the others follow from the closure.
bool Variation::start(In v, Matrix& s) {
  written = general = 0;
  waiting_.clear(), held_.resize(0, 0);
  largest_.setZero(), delay_.setZero(), begins_ = true;
  at_pole_ = false, limits_.clear();
  const Vector here = core_.q_tree, none = Vector::Zero(n), no_force = Vector::Zero(core_.rows.closure.rows);
  s.setZero(2 * n, count);
  compensated_.setZero(core_.d, count);
  Matrix q = Matrix::Zero(n, count), effort, stiffness, place, rate;
  if (table_.target.size()) {
    core_.set(table_.target), core_.reduce();
    balance(q, compensated_, stiffness);
    for (int p = 0; p < count; ++p)
      for (const Effect& of : table_.parameters[p].effects)
        if (of.kind == Effect::target) compensated_.col(p) += stiffness.col(of.index) + of.numbers;
    q.setZero(), core_.set(here);
  }
  core_.reduce();
  Matrix change = Matrix::Zero(n, count);
  for (int p = 0; p < count; ++p) {
    for (int k : core_.q) q(k, p) = table_.parameters[p].q(k);
    for (int k = 0; k < core_.d; ++k) change(core_.q[k], p) = table_.parameters[p].q_dot(k);
  }
  compute(v, none, no_force, false);
  closure_changes(v, place, rate);
  if (!table_.at_equilibrium && q.isZero(0) && change.isZero(0) && place.isZero(0) && rate.isZero(0)) return true;
  if (core_.phi_z.singular() || system_.phi_z_margin() < chart_margin) return false;
  if (table_.at_equilibrium) {
    balance(q, effort, stiffness);
    Eigen::FullPivLU<Matrix> factored(stiffness);
    factored.setThreshold(neutral);
    if (!factored.isInvertible()) return false;
    q -= core_.rho * factored.solve(effort);
    compute(v, none, no_force, false);
  } else {
    close(core_.rows.J * q + place, q);
  }
  s.topRows(n) = q;
  for (int k = 0; k < n; ++k) rate += derivatives_.rate_by_q.col(table_.real_v[k]) * q.row(k);
  close(core_.rows.J * change + rate, change);
  s.bottomRows(n) = change;
  return s.allFinite();
}

bool Variation::what_acts(In v) {
  Joints& joints = core_.joints;
  const Control& control = system_.control;
  answers_ = control.feedback() || joints.acts(), at_pole_ = false;
  clipped_.resize(0, 0);
  if (!answers_ && !control.acts()) {
    acting_ = control.u_tree;
  } else {
    if (!system_.control.slopes(core_, u_by_q_, u_by_v_, acting_)) return false;
    for (size_t k = 0; k < limits_.size(); ++k) at_pole_ |= limits_[k] * limit(static_cast<int>(k)) < 0;
    if (at_pole_) return false;
    if (control.acts() && control.clipped.any) answers_ = true, clipped_efforts(v);
  }
  if (joints.acts()) {
    joints.add_friction(v, acting_);
    back_.setZero(), joints.add_slopes(v, back_);
    u_by_v_.diagonal() += back_;
  }
  for (size_t i = 0; i < joints.locked.size(); ++i) acting_(joints.locked[i]) += joints.forces()(static_cast<Eigen::Index>(i));
  return true;
}

int Variation::limit(int motor) const {
  const Control& control = system_.control;
  return control.limited(motor) ? (control.tau(motor) > 0.0 ? 1 : -1) : 0;
}

void Variation::accept() {
  const Control& control = system_.control;
  limits_.resize(control.acts() && control.feedback() ? static_cast<size_t>(control.tau.size()) : 0);
  for (size_t k = 0; k < limits_.size(); ++k) limits_[k] = limit(static_cast<int>(k));
}

// What acts, where it answers to the state.
void Variation::add_answer(const Eigen::Ref<const Matrix>& s) {
  force_.noalias() += u_by_q_ * s.topRows(n);
  force_.noalias() += u_by_v_ * s.bottomRows(n);
}

void Variation::add_back(Matrix& change) {
  free_ = change;
  back_forces_.resize(static_cast<Eigen::Index>(core_.joints.locked.size()), count);
  for (int p = 0; p < count; ++p) {
    core_.joints.back(responses_, change.col(p), back_);
    change.col(p) += back_, back_forces_.col(p) = core_.joints.back_forces();
  }
}

bool Variation::rates(In v, In a, const Matrix& s, Matrix& s_dot) {
  ++general;
  const bool locked = !core_.joints.locked.empty();
  if (!what_acts(v)) return false;
  core_.set_velocity(v), core_.bias(), core_.tree_inertia();
  core_.D_times(a, lacking_);
  lacking_ += core_.bias_tree - core_.damping_tree - acting_;
  core_.multipliers(lacking_, lambda_);
  compute(v, a, lambda_, false);
  force_.setZero(), row_.setZero();
  add_parameters(v, a, lambda_, false, force_, row_);
  add_acting(core_.q_tree, v, force_);
  add_state(s);
  force_ = -force_;
  if (answers_) add_answer(s);
  if (!core_.respond(force_, row_, change_)) return false;
  if (locked) {
    if (!core_.responses(core_.joints.locked, responses_)) return false;
    add_back(change_);
  }
  s_dot.resize(2 * n, count), move(v, s, s_dot);
  s_dot.bottomRows(n) = change_;
  return s_dot.allFinite();
}

bool Variation::is_written() const {
  return core_.written && core_.written->has_changes() && table_.directions.rows() == core_.written->parameters();
}

// The code may be there from some time of the run on.
void Variation::begin_written() {
  for (int first = 0; first < count; first += core_.written->lanes()) {
    const int here = std::min(count - first, core_.written->lanes()), rows = here == 1 ? 1 : core_.written->lanes();
    Along& along = along_.emplace_back(Along{first, here, {}, {}});
    along.changes.setZero(rows, n), along.directions.setZero(rows, core_.written->directions());
  }
  for (int p = 0; p < count; ++p) groups_.push_back(core_.written->groups(table_.directions.col(p)));
  direction_.setZero(core_.written->directions()), of_group_.setZero(direction_.size() - 2 * n);
}

// What a parameter's change of the state is to the code, where force_ is what acts, or nothing that changes does.
void Variation::direction(const Eigen::Ref<const Matrix>& s, int p, bool acts, Out to) {
  to.head(2 * n) = s.col(p);
  auto more = to.tail(of_group_.size());
  more.setZero();
  if (acts) more.head(n) = force_.col(p);
  for (int group : groups_[static_cast<size_t>(p)]) {
    core_.written->varied(group, table_.directions.col(p), of_group_);
    more += of_group_;
  }
}

bool Variation::written_rates(In q_tree, In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) {
  const bool locked = !core_.joints.locked.empty();
  if (!what_acts(v) || !core_.written->state(q_tree, v, acting_)) return false;
  if (along_.empty()) begin_written();
  ++written;
  const bool acts = answers_ || acting_varies_ || holds();
  if (acts) force_.setZero(), add_acting(q_tree, v, force_), force_ = -force_;
  if (answers_) add_answer(s);
  move(v, s, s_dot);
  for (Along& along : along_) {
    if (along.directions.rows() == 1) {
      direction(s, along.first, acts, direction_);
      core_.written->change(direction_, s_dot.col(along.first).tail(n));
      continue;
    }
    for (int row = 0; row < along.count; ++row) {
      direction(s, along.first + row, acts, direction_);
      along.directions.row(row) = direction_;
    }
    core_.written->changes(along.directions, along.changes);
    for (int row = 0; row < along.count; ++row) s_dot.col(along.first + row).tail(n) = along.changes.row(row);
  }
  if (locked) {
    if (!core_.responses(core_.joints.locked, responses_)) return false;
    change_ = s_dot.bottomRows(n);
    add_back(change_);
    s_dot.bottomRows(n) = change_;
  }
  return true;
}

void Variation::move(In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) const {
  for (int p = 0; p < count; ++p) {
    s_dot.col(p).head(n) = s.col(p).tail(n);
    core_.tree.add_bracket(s.col(p).head(n), v, s_dot.col(p).head(n));
  }
}

void Variation::rates_of_start(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const {
  s_dot.resize(2 * n, count), move(v, s, s_dot);
  s_dot.bottomRows(n).noalias() = by_q * s.topRows(n);
  s_dot.bottomRows(n).noalias() += by_v * s.bottomRows(n);
}

// What a change of the state adds to force_ and row_.
void Variation::add_state(const Matrix& s) {
  const Derivatives& by = derivatives_;
  for (int p = 0; p < count; ++p)
    for (int k = 0; k < n; ++k) {
      const int at = table_.real_v[k];
      const double x = s(k, p), x_dot = s(n + k, p);
      for (Eigen::Index i = 0; i < row_.rows(); ++i) row_(i, p) += by.row_by_q(i, at) * x + by.row_by_v(i, at) * x_dot;
      for (int i = 0; i < n; ++i) {
        const int of = table_.real_v[i];
        force_(i, p) += by.force_by_q(of, at) * x + by.force_by_v(of, at) * x_dot;
      }
    }
}

}  // namespace ckc
