#include "level_set.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double max_step = 0.5;  // rad or m: a longer Newton step in one coordinate is not local any more
constexpr int max_iterations = 12;
constexpr double difference = 1.5e-8;  // step of forward differences, rad or m

LevelSet::LevelSet(Core& core_, double epsilon, bool actual, In w0, double tolerance, double slack)
    : System(core_, 2 * core_.d),
      trail(core_, epsilon),
      epsilon_(epsilon),
      tolerance_(tolerance),
      slack_(slack),
      actual_(actual),
      on_manifold_(w0.isZero(0)),
      w0_(w0) {
  const int m = core.rows.closure.rows;
  q_tree_.setZero(core.tree.nq), tree_.setZero(core.n), step_.setZero(core.n);
  residual_.setZero(m), damping_.setZero(core.n, core.n);
}

void LevelSet::start(In q_tree) {
  const int d = core.d;
  z_.setZero(core.z.size()), gradient_.setZero(d, d), column_.setZero(d);
  moved_.setZero(2 * d), y_dot_.setZero(2 * d), f_.setZero(2 * d);
  trail.start(core, q_tree);
}

void LevelSet::level(double t, Out level) const {
  if (on_manifold_)
    level.setZero();
  else
    level = w0_ * std::exp(-t / epsilon_);
}

bool LevelSet::state(double t, In y, double tolerance) {
  const int d = core.d;
  level(t, w);
  q = y.head(d), q_dot = y.tail(d);
  trail.predict(t, q, core, w, q_tree_);
  if (!newton(tolerance)) return false;
  core.reduce();
  core.velocity(q_dot, v_tree);
  velocity = v_tree;
  if (!on_manifold_) {
    core.solve_z(w, z_);
    for (size_t k = 0; k < core.z.size(); ++k) velocity(core.z[k]) -= z_(k) / epsilon_;
    if (actual_) v_tree = velocity;
  }
  trail.add(t, core, q_tree_, velocity, w);
  return true;
}

// Close phi(q, z) = w on z from q_tree_; J and phi_z's factorization are those of where it ends.
bool LevelSet::newton(double tolerance) {
  double size = 0.0;
  for (int iteration = 0; iteration <= max_iterations; ++iteration) {
    core.set(q_tree_, iteration == expected_);  // D' will be wanted at the end, which is mostly where it was last time
    core.factor();
    residual_ = core.rows.phi - w;
    const double previous = size;
    size = unclosed();
    if (iteration && !(size <= std::max(0.5 * previous, tolerance))) return false;
    if (size <= tolerance) {
      expected_ = iteration;
      return true;
    }
    if (!std::isfinite(size) || core.phi_z.singular() || iteration == max_iterations) return false;
    core.solve_z(residual_, z_);
    if (!(z_.lpNorm<Eigen::Infinity>() <= max_step)) return false;
    step_.setZero();
    for (size_t k = 0; k < core.z.size(); ++k) step_(core.z[k]) = -z_(k);
    core.tree.integrate(q_tree_, step_);
    ++counts.newton, ++counts.factorizations;
  }
  return false;
}

// The largest part of the residual that z could still close: redundant rows may contradict each other slightly.
double LevelSet::unclosed() {
  if (!residual_.allFinite()) return std::nan("");
  if (residual_.size() > static_cast<Eigen::Index>(core.z.size())) {
    core.solve_z(residual_, z_);
    residual_.setZero();
    for (size_t k = 0; k < core.z.size(); ++k) residual_ += z_(k) * core.rows.J.col(core.z[k]);
  }
  return residual_.size() ? residual_.lpNorm<Eigen::Infinity>() : 0.0;
}

void LevelSet::finish(In u_tree, Out y_dot) {
  core.inertia();
  core.bias(v_tree);
  accelerate(u_tree, y_dot);
}

void LevelSet::accelerate(In u_tree, Out y_dot) {
  const int d = core.d;
  counts.factorizations += 2;  // phi_z and D
  y_dot.head(d) = q_dot;
  if (actual_ && !on_manifold_) {
    core.coriolis();
    core.actual_acceleration(u_tree, q_dot, y_dot.tail(d));
  } else {
    core.reduced_acceleration(u_tree, y_dot.tail(d));
  }
}

bool LevelSet::rhs(double t, In y, Out y_dot) {
  if (!y.allFinite() || !open(t, y)) return false;
  core.inertia();
  core.bias(v_tree);
  drive.act(t, core, q, q_dot);
  accelerate(drive.u_tree, y_dot);
  return y_dot.allFinite();
}

bool LevelSet::jacobian(double t, In y, Matrix& jacobian) {
  const int d = core.d;
  if (!rhs(t, y, f_) || !exact(t, y)) return false;
  core.inertia();
  core.bias(v_tree);
  core.coriolis();
  jacobian.setZero();
  for (int k = 0; k < d; ++k) {  // C(x) y = C(y) x, so that d(C q_dot)/d q_dot = 2 C
    column_.setZero();
    column_(k) = 1.0;
    core.C_times(column_, gradient_.col(k));
  }
  jacobian.bottomRightCorner(d, d) = -2 * gradient_;
  if (core.springs.any_damping) {
    damping_.setZero();
    core.springs.add_damping_gradient(damping_);
    for (int k = 0; k < d; ++k) {
      tree_.noalias() = damping_ * core.rho.col(k);
      core.reduced(tree_, column_);
      jacobian.col(d + k).tail(d) += column_;
    }
  }
  drive.rate_gradient(t, core, q, q_dot, gradient_);
  jacobian.bottomRightCorner(d, d) += gradient_;
  for (int k = 0; k < d; ++k) {
    column_ = jacobian.col(d + k).tail(d);
    core.D_factor.solve(column_, jacobian.col(d + k).tail(d));
    jacobian(k, d + k) = 1.0;
  }
  for (int k = 0; k < d; ++k) {
    moved_ = y;
    moved_(k) += difference;
    if (!rhs(t, moved_, y_dot_)) return false;
    jacobian.col(k).tail(d) = (y_dot_.tail(d) - f_.tail(d)) / (moved_(k) - y(k));
  }
  return jacobian.allFinite();
}

}  // namespace ckc
