// How eq. 16's u changes with the state.
#include "control/control.hpp"

#include <algorithm>

namespace ckc {

// u = rho^T m - K_D r with m = D' a' + C' v2 + h', where v1 = v', v2 = rho v and a' = rho a + rho_dot v. C' v2 and
// J_dot v2 are half of what v1 + v2 and v1 - v2 make of C' v and J_dot v apart; where a root's axes turn those are means
// of C'(v1) v2 and C'(v2) v1, which differ by D' times what the two velocities lack in common, and a' by the same.
// With m = J^T lambda + u on q, and since rho^T J^T = 0, the change of rho is that of J^T lambda.
bool Tracking::slopes(Core& plant, const Indices& own, Matrix& by_q, Matrix& by_v) {
  Core& core = model_ ? *model_ : plant;
  const Indices& single = core.tree.single;
  for (int k : own)
    if (!std::binary_search(single.begin(), single.end(), k)) return false;
  if (core.q != own) return false;
  const bool turns = !core.tree.roots.empty();
  const int n = core.n, d = core.d, m = core.rows.closure.rows;
  const bool follows = model_ && !actual_;  // v1 = rho q_dot of its own
  core.reduce(), core.tree_inertia();
  const Vector v1 = follows ? Vector(core.rho * (r_ + v_)) : plant.v_tree, v2 = core.rho * v_;
  core.jacobian_rate(v1);
  const Matrix J = core.rows.J, &rho = core.rho;
  const auto close = [&](const Matrix& residual, Matrix& x) {  // z's rows of x so that J x = -residual, q's being given
    Vector step(n), lacking(m);
    for (Eigen::Index k = 0; k < x.cols(); ++k) {
      for (int i : core.z) x(i, k) = 0.0;
      lacking = residual.col(k) + J * x.col(k);
      core.z_step(lacking, step);
      x.col(k) += step;
    }
  };
  Matrix a = Matrix::Zero(n, 1);
  for (int k = 0; k < d; ++k) a(own[k], 0) = a_(k);
  Vector opens = core.rows.J_dot * v2;
  if (turns) core.jacobian_rate(v2), opens = (opens + core.rows.J_dot * v1) / 2;
  close(opens, a);
  const Vector none = Vector::Zero(n), no_force = Vector::Zero(m);
  const auto changes = [&](In v, In a_there, In lambda, bool inertial) {
    core.derivatives.compute(core.q_tree, v, a_there, lambda, inertial);
    return &core.derivatives;
  };
  const auto* by = changes(v1 + v2, 2 * a, no_force, true);
  Matrix force_q = by->force_by_q / 4, row_q = by->row_by_q / 4, plus = by->force_by_v / 4, row_plus = by->row_by_v / 4;
  by = changes(v1 - v2, -2 * a, no_force, true);
  force_q -= by->force_by_q / 4, row_q -= by->row_by_q / 4;
  const Matrix force_1 = plus - by->force_by_v / 4, force_2 = plus + by->force_by_v / 4;
  const Matrix row_1 = row_plus - by->row_by_v / 4, row_2 = row_plus + by->row_by_v / 4;
  Vector moved(n), m_tree(n);
  core.D_times(a.col(0), moved);
  Vector apart = Vector::Zero(n);
  if (turns) core.set_velocity(v2), core.coriolis(), core.C_tree_times(v1, apart);
  core.set_velocity(v1), core.coriolis();
  core.C_tree_times(v2, m_tree);
  if (turns) m_tree = (m_tree + apart) / 2;
  m_tree += moved + core.h_tree;
  Vector u(d), lambda(m);
  core.reduced(m_tree, u);
  for (int k = 0; k < d; ++k) m_tree(own[k]) -= u(k);
  core.multipliers(m_tree, lambda);
  by = changes(none, none, lambda, false);
  force_q += by->force_by_q;
  Matrix in_q = Matrix::Zero(d, n);  // of q in q'
  for (int k = 0; k < d; ++k) in_q(k, own[k]) = 1.0;
  const auto closed = [&](const Matrix& of_q, const Matrix& residual) {
    Matrix x = Matrix::Zero(n, n);
    for (int k = 0; k < d; ++k) x.row(own[k]) = of_q.row(k);
    close(residual, x);
    return x;
  };
  const Matrix nothing = Matrix::Zero(m, n), zero = Matrix::Zero(d, n);
  Matrix opened;  // J v1 = 0 and J v2 = 0 turn with the configuration
  core.closure_rate(v1, opened);
  const Matrix v1_q = follows ? closed(zero, opened) : Matrix(Matrix::Zero(n, n));
  const Matrix v1_v = follows ? closed(in_q, nothing) : Matrix(Matrix::Identity(n, n));
  core.closure_rate(v2, opened);
  const Matrix v2_q = closed(-Lambda_ * in_q, opened);
  const Matrix a_q = closed(zero, row_q + row_1 * v1_q + row_2 * v2_q);
  const Matrix a_v = closed(-Lambda_ * in_q, row_1 * v1_v);
  Matrix changed_q = force_q + force_1 * v1_q + force_2 * v2_q, changed_v = force_1 * v1_v;
  for (int k = 0; k < n; ++k) {
    core.D_times(a_q.col(k), moved), changed_q.col(k) += moved;
    core.D_times(a_v.col(k), moved), changed_v.col(k) += moved;
  }
  by_q = rho.transpose() * changed_q - K_D_ * Lambda_ * in_q;
  by_v = rho.transpose() * changed_v - K_D_ * in_q;
  core.set_velocity(v1), core.jacobian_rate(v1);
  return by_q.allFinite() && by_v.allFinite();
}

// Lambda is in v, in a and in r = q_dot - v.
void Tracking::by_gains(const Measured& at, const Matrix& Lambda, const Matrix& K_D, Out more) {
  Core& core = model_ ? *model_ : at.core;
  core.inertia(), core.coriolis();
  const Vector of_v = Lambda * e_, of_a = Lambda * e_dot_;
  core.C_times(of_v, product_);
  more = -product_ - core.D * of_a - K_D_ * of_v - K_D * r_;
}

}  // namespace ckc
