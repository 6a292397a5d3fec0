#include "dae.hpp"

#include <algorithm>

namespace ckc {

constexpr int most_steps = 10;
constexpr double negligible = 1e-9;  // rad, m: Newton's last step onto the closure

static double largest(In x) { return x.size() ? x.lpNorm<Eigen::Infinity>() : 0.0; }

Dae::Dae(Core& core_, double tolerance, bool projects, double alpha, double beta)
    : System(core_, core_.tree.nq + core_.n), tolerance_(tolerance), alpha_(alpha), beta_(beta), projects_(projects) {
  needs_chart = false, crosses = projects;
  q_tree_.setZero(core.tree.nq), step_.setZero(core.n), residual_.setZero(core.rows.closure.rows);
}

void Dae::set(In q_tree, bool with_inertia) {
  core.set(q_tree, with_inertia);
  if (drive.controls()) {
    core.factor(), core.reduce(), core.inertia();
  } else {
    core.rows.jacobian(core.tree);
  }
  placed_ = with_inertia ? core.sets : -1;
}

// Unless the core was left there.
bool Dae::place(In y) {
  q_tree_ = y.head(core.tree.nq);
  if (!q_tree_.allFinite()) return false;
  core.tree.normalize(q_tree_);
  if (placed_ != core.sets || q_tree_ != core.q_tree) set(q_tree_);
  return true;
}

bool Dae::rhs(double t, In y, Out y_dot) {
  if (!y.allFinite()) return false;
  place(y);
  return rate(t, y.tail(core.n), y_dot);
}

void Dae::independent(In v) {
  for (int k = 0; k < core.d; ++k) q(k) = core.q_tree(core.tree.place[core.q[k]]), q_dot(k) = v(core.q[k]);
}

bool Dae::rate(double t, In v, Out y_dot) {
  const int n = core.n;
  core.bias(v);
  independent(v);
  drive.act(t, core, q, q_dot);
  residual_.setZero();
  if (alpha_ != 0.0 || beta_ != 0.0) {
    residual_.noalias() = core.rows.J * core.v_tree;
    residual_ = 2 * alpha_ * residual_ + beta_ * beta_ * core.rows.phi;
  }
  counts.factorizations += 2;
  core.tree.configuration_rate(core.q_tree, v, y_dot.head(core.tree.nq));
  return core.dae_acceleration(drive.u_tree, residual_, y_dot.tail(n)) && y_dot.allFinite();
}

bool Dae::project(In y) {
  const int n = core.n;
  place(y);
  for (int k = 0; largest(core.rows.phi) > tolerance_; ++k) {
    if (k == most_steps || !core.rows.phi.allFinite() || !core.closing_step(core.rows.phi, step_)) return false;
    ++counts.newton, counts.factorizations += 2;
    residual_.noalias() = core.rows.J * step_;
    core.tree.integrate(q_tree_, step_);
    set(q_tree_);
    if (largest(residual_) <= tolerance_) break;  // what else remains, rows contradict
  }
  residual_.noalias() = core.rows.J * y.tail(n);
  if (!core.closing_step(residual_, step_)) return false;
  velocity = y.tail(n) + step_;
  return velocity.allFinite();
}

bool Dae::rate_on_closure(double t, In y, Out y_dot) {
  const int n = core.n;
  if (!y.allFinite()) return false;
  q_tree_ = y.head(core.tree.nq);
  core.tree.normalize(q_tree_);
  set(q_tree_, false);
  for (int k = 0;; ++k) {
    if (k == most_steps || !core.shortest_step(core.rows.phi, step_)) return false;
    ++counts.factorizations;
    core.tree.integrate(q_tree_, step_);
    set(q_tree_);
    if (largest(step_) <= negligible) break;  // what is left is its square
  }
  residual_.noalias() = core.rows.J * y.tail(n);
  if (!core.shortest_step(residual_, step_)) return false;
  ++counts.factorizations;
  velocity = y.tail(n) + step_;
  return rate(t, velocity, y_dot);
}

bool Dae::exact(double, In y) {
  const int n = core.n;
  if (projects_) {
    if (!project(y)) return false;
  } else {
    place(y);
    velocity = y.tail(n);
  }
  v_tree = velocity;
  independent(velocity);
  return true;
}

bool Dae::at_last(double, In y) {
  place(y);
  velocity = v_tree = y.tail(core.n);
  return true;
}

bool Dae::accept(double, Out y, bool& changed) {
  const int n = core.n;
  changed = false;
  if (!projects_) return true;
  place(y);
  residual_.noalias() = core.rows.J * y.tail(n);
  const double drift_rate = largest(residual_) / (1.0 + largest(y.tail(n)));
  if (std::max(largest(core.rows.phi), drift_rate) <= tolerance_) return true;
  if (!project(y)) return false;
  y.head(core.tree.nq) = core.q_tree, y.tail(n) = velocity;
  changed = true;
  return true;
}

}  // namespace ckc
