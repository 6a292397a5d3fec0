#include "motion/level_set.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ckc {

constexpr double switch_margin = 0.03;  // of |J|: phi_z's least singular value where an uncontrolled run looks for a better q;
constexpr double fallen = 0.7;          // it looks again at so much of the margin at which none was found,
constexpr double poor = 1e-3;           // and from there on at every step
constexpr double clearly = 2.0;         // times as far from singular: a better q
constexpr double weight = 3.0, patience = 100.0;  // of a refused step, in steps as before it; until none is tried
constexpr double rounding = 8 * std::numeric_limits<double>::epsilon();
constexpr double gone = 100.0;  // epsilons after which w is no more

LevelSet::LevelSet(Core& core_, Control& control_, double epsilon, bool actual, double tolerance, double slack)
    : System(core_, control_, 2 * core_.d),
      epsilon_(epsilon),
      tolerance_(tolerance),
      slack_(slack),
      actual_(actual),
      own_{core.q, core.z},
      alarm_(switch_margin),
      predictor_(core, epsilon),
      closing_(core) {
  const int m = core.rows.closure.rows;
  q_tree_.setZero(core.tree.nq), step_.setZero(core.n), residual_.setZero(m), a_tree_.setZero(core.n), w0_.setZero(m), z_.setZero(core.z.size());
}

void LevelSet::start(double t, In q_tree, In v, In w_start, Out y) {
  if (core.q != own_.q) core.split(own_.q, own_.z);
  refusals_ = 0, balance_ = 0.0, closing_.expected = 0;
  elimination.start(core);
  t_start_ = accepted_ = t, w0_ = w_start, on_manifold_ = w0_.isZero(0);
  core.set(q_tree);
  core.reduce();
  begin(q_tree);
  chart_numbers(y);
  for (int k = 0; k < core.d; ++k) y(core.d + k) = v(core.q[k]);
}

void LevelSet::begin(In q_tree) {
  chart_.start(core, q_tree);
  predictor_.start(core, q_tree);
  anchor_ = arrived_ = q_tree;
  alarm_ = switch_margin;
  new_partition();
}

void LevelSet::chart_numbers(Out y) { chart_.numbers(core, core.q_tree, y.head(core.d)); }

void LevelSet::level(double t) {
  if (on_manifold_)
    w.setZero();
  else
    w = w0_ * std::exp(-(t - t_start_) / epsilon_);
}

bool LevelSet::state(double t, In y, double tolerance) {
  const int d = core.d;
  level(t);
  predictor_.predict(t, y.head(d), chart_, core, w, q_tree_);
  if (!close(tolerance)) {
    predict_from_accepted();
    predictor_.predict(t, y.head(d), chart_, core, w, q_tree_);
    if (!close(tolerance)) return false;
  }
  if (chart_.plain())
    q = y.head(d);
  else
    for (int k = 0; k < d; ++k) q(k) = core.q_tree(core.tree.place[core.q[k]]);
  core.reduce();
  q_dot = y.tail(d);
  core.velocity(q_dot, v_tree);
  velocity = v_tree;
  if (!on_manifold_) {
    core.solve_z(w, z_);
    for (size_t k = 0; k < core.z.size(); ++k) velocity(core.z[k]) -= z_(k) / epsilon_;
    if (actual_) v_tree = velocity;
  }
  predictor_.add(t, core, core.q_tree, velocity, w);
  return true;
}

bool LevelSet::at_start(double t, In y) {
  if (!exact(t, y)) return false;
  arrived_ = core.q_tree;
  elimination.begin(core, v_tree);
  return true;
}

// A state next to where phi_z is singular has to be closed exactly, or nothing after it can be.
bool LevelSet::at_last(double t, In y) {
  if (margin() < poor && !exact(t, y)) return false;
  arrived_ = core.q_tree;
  if (elimination.is_due()) elimination.remember(core.q_tree, v_tree, acting(v_tree));
  return true;
}

bool LevelSet::shows(In y, int k, bool rate, double& value) const {
  const auto at = std::find(core.q.begin(), core.q.end(), k);
  if (at == core.q.end() || !(rate || chart_.plain())) return false;
  return value = y((rate ? core.d : 0) + (at - core.q.begin())), true;
}

bool LevelSet::close(double tolerance) {
  closing_.corrections = 0;
  const bool closed = closing_.close(q_tree_, w, tolerance, to_rounding_ || refusals_ > 1);
  counts.newton += closing_.corrections, counts.factorizations += closing_.corrections;
  return closed;
}

bool LevelSet::rhs(double t, In y, Out y_dot) {
  const int d = core.d;
  if (!finite(y)) return fails(Trouble::infinite);
  if (!state(t, y, refusals_ || to_rounding_ ? tolerance_ : std::max(tolerance_, slack_))) return fails(Trouble::open);
  core.set_velocity(v_tree);
  if (!act(t)) return false;
  counts.factorizations += 2;  // phi_z and D
  if (chart_.plain())
    y_dot.head(d) = q_dot;
  else
    chart_.rate(core, core.q_tree, q_dot, y_dot.head(d));
  // On the manifold eq. 6 is eq. 1 at rho q_dot.
  const Vector& force = acting(v_tree);
  const bool locked = !core.joints.locked.empty(), compiled = on_manifold_ && core.written && !locked;
  of_tree_ = compiled && core.written_acceleration(core.q_tree, v_tree, force, uncorrected_, a_tree_);
  if (compiled && !of_tree_) ++counts.pivoted;
  if (!of_tree_ && (locked || (on_manifold_ && core.uses_levels()))) {
    if (!eq_1(v_tree, uncorrected_, a_tree_)) return false;
    of_tree_ = true;
  }
  if (of_tree_)
    for (int k = 0; k < d; ++k) y_dot(d + k) = a_tree_(core.q[k]);
  else if (actual_ && !on_manifold_)
    core.actual_acceleration(force, q_dot, y_dot.tail(d));
  else
    core.reduced_acceleration(force, y_dot.tail(d));
  return finite(y_dot) || fails(Trouble::infinite);
}

bool LevelSet::jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  if ((on_manifold_ || !actual_) && exact_jacobian(t, y, jacobian)) return true;
  to_rounding_ = true;  // what the slack of the loops leaves open is far more than a difference moves
  const bool exists = System::jacobian(t, y, jacobian, evaluations);
  to_rounding_ = false;
  return exists;
}

// Of eq. 1 at q'(q) and v' = rho(q) q_dot: d q' / d q = rho, d v' / d q = rho_dot but for a free root, whose axes turn,
// d v' / d q_dot = rho.
bool LevelSet::exact_jacobian(double t, In y, Matrix& jacobian) {
  const int d = core.d, n = core.n;
  if (!finite(y) || !state(t, y, tolerance_)) return false;
  core.set_velocity(v_tree);
  if (!act(t) || !slopes(core.q_tree, v_tree, uncorrected_, by_q_, by_v_)) return false;
  core.jacobian_rate(v_tree);
  rho_dot_.resize(n, d);
  for (int k = 0; k < d; ++k) {
    unit_.setUnit(d, k);
    core.rho_dot_times(unit_, rho_dot_.col(k));
  }
  if (!core.tree.roots.empty()) {
    const Matrix turned = core.tree.brackets(v_tree) * core.rho;
    for (int k = 0; k < d; ++k) {  // J x = J turned, x of z alone
      residual_.noalias() = core.rows.J * turned.col(k);
      core.z_step(residual_, step_);
      rho_dot_.col(k) -= step_;
    }
  }
  jacobian.setZero(2 * d, 2 * d);
  jacobian.topRightCorner(d, d).setIdentity();
  for (int k = 0; k < d; ++k) {
    const auto row = by_q_.row(core.q[k]), row_v = by_v_.row(core.q[k]);
    jacobian.row(d + k).head(d).noalias() = row * core.rho;
    jacobian.row(d + k).head(d).noalias() += row_v * rho_dot_;
    jacobian.row(d + k).tail(d).noalias() = row_v * core.rho;
  }
  if (!chart_.plain()) chart_.jacobian(core, core.q_tree, q_dot, jacobian);
  return jacobian.allFinite();
}

void LevelSet::rates(std::vector<std::pair<int, int>>& of) const {
  of.clear();
  const Indices& single = core.tree.single;
  for (int k = 0; k < core.d; ++k)
    if (std::binary_search(single.begin(), single.end(), core.q[k])) of.emplace_back(k, core.d + k);
}

bool LevelSet::tree_acceleration(In f, Out a) const {
  if (!on_manifold_) return false;
  const auto q_ddot = f.tail(core.d);
  if (!of_tree_) return core.tree_acceleration(q_ddot, a), true;
  a = a_tree_;  // at another q_ddot than f's, which an implicit method asks for
  for (int k = 0; k < core.d; ++k) a += (q_ddot(k) - a_tree_(core.q[k])) * core.rho.col(k);
  return true;
}

void LevelSet::push(Out y, In v) const {
  for (int k = 0; k < core.d; ++k) y(core.d + k) += v(core.q[k]);
}

void LevelSet::shift(Out y, In step) const {
  if (!chart_.plain()) return;
  for (int k = 0; k < core.d; ++k) y(k) += step(core.q[k]);
}

void LevelSet::go_on(double t, Out y) {
  begin(core.q_tree);
  chart_numbers(y);
  accepted_ = t;
}

bool LevelSet::return_to_accepted() {
  ++refusals_, balance_ += weight;
  if (balance_ > patience) {
    if (!elimination.give_up(core)) return fails(Trouble::vague);
    balance_ = 0.0;  // by the other elimination the steps may be good
  }
  alarm_ = std::numeric_limits<double>::infinity();
  predict_from_accepted();
  return true;
}

void LevelSet::predict_from_accepted() {
  core.set(anchor_);
  core.reduce();
  predictor_.start(core, anchor_);
}

void LevelSet::whole(In f, Out x, Out x_dot) const {
  core.tree.configuration_rate(core.q_tree, velocity, x_dot.head(core.tree.nq));
  if (on_manifold_) {
    x << core.q_tree, velocity;
    tree_acceleration(f, x_dot.tail(core.n));
  } else {
    x << core.q_tree, q_dot;
    x_dot.tail(core.d) = f.tail(core.d);
  }
}

// y is rounded as its largest number is, a crank's angle after many turns, and z follows it: an angle that passes zero is
// not known better. What a nearly singular phi_z makes of that is not rounding.
void LevelSet::add_rounding(In x, Out scale) const {
  const Vector& units = core.scales.columns;
  double largest = 0.0;
  for (int k : core.tree.single) largest = std::max(largest, std::abs(x(core.tree.place[k])) / units(k));
  for (int k : core.tree.single) scale(core.tree.place[k]) += rounding * largest * units(k);
  if (on_manifold_) scale.tail(core.n) += rounding * x.tail(core.n).cwiseQuotient(units).lpNorm<Eigen::Infinity>() * units;
}

// Off the manifold eq. 8 is another model in other q (z_dot alone closes the loops), so there q stays.
Accepted LevelSet::accept(double t, Out y, double here) {
  anchor_ = arrived_;
  elimination.accept(core);
  if (balance_ == 0.0) length_ = t - accepted_;
  if (length_ > 0.0) balance_ = std::max(0.0, balance_ - (t - accepted_) / length_);
  accepted_ = t;
  level(t);
  if (!on_manifold_ && t - t_start_ > gone * epsilon_) return on_manifold_ = true, Accepted::changed;
  if (may_switch && here < alarm_ && !(w.lpNorm<Eigen::Infinity>() > tolerance_)) {
    alarm_ = std::max(fallen * here, poor);
    Partition better;
    if (exact(t, y) && best_partition(core, better) && better.q != core.q) {
      const Partition present{core.q, core.z};
      if (move_to(better, t, y)) {
        if (margin() > clearly * here) {
          ++counts.switches;
          refusals_ = 0, balance_ = 0.0;
          return Accepted::restarted;
        }
        move_to(present, t, y);
        alarm_ = std::max(fallen * here, poor);
      }
    }
  }
  if (!(here > chart_margin)) return Accepted::refused;
  if (!chart_.outgrown(y.head(core.d))) return Accepted::kept;
  if (!exact(t, y)) return Accepted::refused;
  begin(core.q_tree);
  chart_numbers(y);
  return Accepted::restarted;
}

// Write the core's state in other coordinates; false where phi_z is singular in them.
bool LevelSet::move_to(const Partition& partition, double t, Out y) {
  const Vector q_tree = core.q_tree, v = velocity;
  core.split(partition.q, partition.z);
  z_.setZero(core.z.size());
  core.set(q_tree);
  core.reduce();
  begin(q_tree);
  chart_numbers(y);
  for (int k = 0; k < core.d; ++k) y(core.d + k) = v(core.q[k]);
  return !core.phi_z.singular() && exact(t, y);
}

bool LevelSet::own_partition(double t, Out y, bool& changed) {
  changed = core.q != own_.q;
  if (!changed) return true;
  return exact(t, y) && move_to(own_, t, y) && margin() > chart_margin;
}

}  // namespace ckc
