#include "motion/dae.hpp"

#include <algorithm>

#include "loops/compiled_terms.hpp"

namespace ckc {

constexpr int most_steps = 10;
constexpr double longer = 4.0;       // times: next to where phi_z is singular, z alone has far to go
constexpr double rounding = 2e-16;   // of a product: a velocity that is allowed to the last digit stays what it is
constexpr double negligible = 1e-9;  // rad, or of the mechanism's size: Newton's last step onto the closure

static double largest(In x) { return x.size() ? x.lpNorm<Eigen::Infinity>() : 0.0; }

Dae::Dae(Core& core_, Control& control_, double tolerance, bool projects, double alpha, double beta)
    : System(core_, control_, core_.tree.nq + core_.n),
      tolerance_(tolerance),
      alpha_(alpha),
      beta_(beta),
      projects_(projects) {
  crosses = projects;
  q_tree_.setZero(core.tree.nq), step_.setZero(core.n), z_step_.setZero(core.n), unforced_.setZero(core.n), residual_.setZero(core.rows.closure.rows);
}

void Dae::start(double, In q_tree, In v, In, Out y) {
  elimination.start(core);
  y << q_tree, v;
}

void Dae::set(In q_tree, bool with_inertia) {
  core.set(q_tree, with_inertia);
  core.jacobian();
  placed_ = with_inertia ? core.sets : -1;
}

// Unless the core was left there.
bool Dae::place(In y) {
  q_tree_ = y.head(core.tree.nq);
  if (!q_tree_.allFinite()) return false;
  if (placed_ == core.sets && q_tree_ == core.q_tree) return true;  // though to normalise it again may change a digit
  core.tree.normalize(q_tree_);
  if (placed_ != core.sets || q_tree_ != core.q_tree) set(q_tree_);
  return true;
}

bool Dae::rhs(double t, In y, Out y_dot) {
  if (!finite(y)) return fails(Trouble::infinite);
  const auto v = y.tail(core.n);
  if (core.written && core.joints.locked.empty() && !control.needs_terms() && !stabilised()) {  // no term but the acceleration is needed
    q_tree_ = y.head(core.tree.nq);
    core.tree.normalize(q_tree_);
    const bool acts = control.acts() || core.joints.acts();
    if (acts && !forces(t, q_tree_, v)) return false;
    if (core.written_acceleration(q_tree_, v, acts ? acting(v) : unforced_, uncorrected_, y_dot.tail(core.n))) {
      counts.factorizations += 2;
      core.tree.configuration_rate(q_tree_, v, y_dot.head(core.tree.nq));
      return finite(y_dot) || fails(Trouble::infinite);
    }
    ++counts.pivoted;
  } else if (core.written && !core.written->eliminates()) {
    ++counts.pivoted;
  }
  place(y);
  return rate(t, v, y_dot);
}

bool Dae::forces(double t, In q_tree, In v) {
  independent(q_tree, v);
  v_tree = v;
  return act(t);
}

void Dae::independent(In q_tree, In v) {
  for (int k = 0; k < core.d; ++k) q(k) = q_tree(core.tree.place[core.q[k]]), q_dot(k) = v(core.q[k]);
}

bool Dae::rate(double t, In v, Out y_dot) {
  const int n = core.n;
  core.set_velocity(v);
  if (!forces(t, core.q_tree, v)) return false;
  residual_.setZero();
  if (stabilised()) {
    residual_.noalias() = core.rows.J * core.v_tree;
    residual_ = 2 * alpha_ * residual_ + beta_ * beta_ * core.rows.phi;
  }
  counts.factorizations += 2;
  core.tree.configuration_rate(core.q_tree, v, y_dot.head(core.tree.nq));
  if (!eq_1(v, residual_, y_dot.tail(n))) return false;
  return finite(y_dot) || fails(Trouble::infinite);
}

// In numbers: a free root's quaternion stands for the rotation that it is normalised to.
bool Dae::jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  const int n = core.n, nq = core.tree.nq;
  if (!finite(y)) return false;
  q_tree_ = y.head(nq);
  core.tree.normalize(q_tree_);
  const auto v = y.tail(n);
  if (!core.written || !core.joints.locked.empty() || control.needs_terms() || stabilised()) place(y), core.set_velocity(v);
  if (!forces(t, q_tree_, v)) return false;
  residual_.setZero();
  if (stabilised()) {
    residual_.noalias() = core.rows.J * v;
    residual_ = 2 * alpha_ * residual_ + beta_ * beta_ * core.rows.phi;
  }
  if (!slopes(q_tree_, v, residual_, by_q_, by_v_)) return System::jacobian(t, y, jacobian, evaluations);
  if (stabilised() && core.rows.closure.rows) {
    Derivatives& by = core.derivatives;
    by.compute(q_tree_, v, a_, uncorrected_);  // of the rows alone; terms written out have left none
    const Matrix none = Matrix::Zero(n, n);
    if (!core.respond(none, 2 * alpha_ * by.rate_by_q + beta_ * beta_ * by.J, more_)) return false;
    by_q_ += more_;
    if (!core.respond(none, 2 * alpha_ * by.J, more_)) return false;
    by_v_ += more_;
  }
  jacobian.setZero(nq + n, nq + n);
  for (int k : core.tree.single) jacobian(core.tree.place[k], nq + k) = 1.0;
  for (const Tree::Root& root : core.tree.roots)
    for (int k = root.v; k < root.v + 6; ++k) core.tree.configuration_rate(q_tree_, Vector::Unit(n, k), jacobian.col(nq + k).head(nq));
  jacobian.bottomRightCorner(n, n) = by_v_;
  if (nq == n) {
    jacobian.bottomLeftCorner(n, n) = by_q_;
  } else {
    const Matrix tangents = core.tree.tangents(y.head(nq));
    jacobian.topLeftCorner(nq, nq) = core.tree.rate_changes(q_tree_, v) * tangents;
    jacobian.bottomLeftCorner(n, nq) = by_q_ * tangents;
  }
  return finite(jacobian.reshaped());
}

// Stiff control would answer to any change of what it sees: where one acts, z alone is moved, unless that takes steps
// far longer than the loops need.
bool Dae::closing_step(In residual) {
  if (!core.closing_step(residual, step_)) return false;
  if (!control.acts()) return true;
  core.factor();
  if (core.phi_z.singular()) return true;
  core.z_step(residual, z_step_);
  const Vector& units = core.scales.columns;
  if (z_step_.cwiseQuotient(units).norm() < longer * step_.cwiseQuotient(units).norm()) step_ = z_step_;
  return true;
}

bool Dae::project(In y) {
  const int n = core.n;
  place(y);
  const double tolerance = tolerance_ * core.coarseness();
  for (int k = 0; largest(core.rows.phi) > tolerance; ++k) {
    if (k == most_steps || !core.rows.phi.allFinite() || !closing_step(core.rows.phi)) return false;
    ++counts.newton, counts.factorizations += 2;
    residual_.noalias() = core.rows.J * step_;
    core.tree.integrate(q_tree_, step_);
    set(q_tree_);
    if (largest(residual_) <= tolerance) break;  // what else remains, rows contradict
  }
  velocity = y.tail(n);
  residual_.noalias() = core.rows.J * velocity;
  if (largest(residual_) <= rounding * core.rows.J.norm() * velocity.norm()) return true;
  if (!closing_step(residual_)) return false;
  velocity += step_;
  return velocity.allFinite();
}

bool Dae::rate_on_closure(double t, In y, Out y_dot) {
  const int n = core.n;
  if (!finite(y)) return false;
  q_tree_ = y.head(core.tree.nq);
  core.tree.normalize(q_tree_);
  set(q_tree_, false);
  for (int k = 0;; ++k) {
    if (k == most_steps || !core.step_onto_closure(core.rows.phi, step_)) return false;
    ++counts.factorizations;
    core.tree.integrate(q_tree_, step_);
    set(q_tree_);
    if (largest(step_.cwiseQuotient(core.scales.columns)) <= negligible) break;  // what is left is its square
  }
  residual_.noalias() = core.rows.J * y.tail(n);
  if (!core.step_onto_closure(residual_, step_)) return false;
  ++counts.factorizations;
  velocity = y.tail(n) + step_;
  return rate(t, velocity, y_dot);
}

void Dae::rates(std::vector<std::pair<int, int>>& of) const {
  of.clear();
  for (int k : core.tree.single) of.emplace_back(core.tree.place[k], core.tree.nq + k);
}

// Along the velocities that the loops allow: across them nothing moves, whatever the Jacobian off the closure says.
bool Dae::modes(In y, Matrix& jacobian) {
  const int n = core.n, nq = core.tree.nq, d = n - core.rank;
  place(y);
  const Matrix* tangent = core.tangent();
  if (!tangent) return false;
  Matrix moves(nq, d), found = Matrix::Zero(2 * d, 2 * d);
  for (int k = 0; k < d; ++k) core.tree.configuration_rate(q_tree_, tangent->col(k), moves.col(k));
  const auto along = (tangent->transpose() * *tangent).ldlt();
  found.topRightCorner(d, d).setIdentity();
  found.bottomLeftCorner(d, d) = along.solve(tangent->transpose() * (jacobian.bottomLeftCorner(n, nq) * moves));
  found.bottomRightCorner(d, d) = along.solve(tangent->transpose() * (jacobian.bottomRightCorner(n, n) * *tangent));
  jacobian = found;
  return true;
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
  independent(core.q_tree, velocity);
  return true;
}

bool Dae::at_start(double t, In y) {
  if (!exact(t, y)) return false;
  elimination.begin(core, v_tree);
  return true;
}

bool Dae::at_last(double, In y) {
  place(y);
  velocity = v_tree = y.tail(core.n);
  if (elimination.is_due()) elimination.remember(core.q_tree, v_tree, acting(v_tree));
  return true;
}

bool Dae::as_is(double, In y) {
  if (!place(y)) return false;
  velocity = v_tree = y.segment(core.tree.nq, core.n);
  independent(core.q_tree, velocity);
  return true;
}

bool Dae::shows(In y, int k, bool rate, double& value) const {
  const int nq = core.tree.nq;
  if (!rate && nq != core.n && !std::binary_search(core.tree.single.begin(), core.tree.single.end(), k)) return false;
  return value = y(rate ? nq + k : core.tree.place[k]), true;
}

void Dae::put_exact(Out y) const {
  if (projects_) y.head(core.tree.nq) = core.q_tree, y.segment(core.tree.nq, core.n) = velocity;
}

Accepted Dae::accept(double, Out y, double) {
  const int n = core.n;
  elimination.accept(core);
  if (!projects_) return Accepted::kept;
  place(y);
  residual_.noalias() = core.rows.J * y.tail(n);
  const double drift_rate = largest(residual_) / (1.0 + largest(y.tail(n)));
  if (std::max(largest(core.rows.phi), drift_rate) <= tolerance_ * core.coarseness()) return Accepted::kept;
  if (!project(y)) return Accepted::refused;
  put_exact(y);
  return Accepted::changed;
}

}  // namespace ckc
