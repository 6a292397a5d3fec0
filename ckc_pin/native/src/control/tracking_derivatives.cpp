// Derivatives of eq. 16's u with respect to the state.
#include "control/control.hpp"

#include <algorithm>

namespace ckc {

// u = rho^T m - K_D r with m = D' a' + C' v2 + h', where v1 = v', v2 = rho v and a' = rho a + rho_dot v. Since C' v
// is quadratic in v, C' v2 and J_dot v2 follow from its values at v1 + v2 and v1 - v2 (polarization). With free roots
// these are means of C'(v1) v2 and C'(v2) v1, which differ by D' times the bracket of the two velocities; a' differs
// by the same amount. With m = J^T lambda + u on q and rho^T J^T = 0, the derivative of rho reduces to that of J^T
// lambda.
bool TrackingController::derivatives(Core& plant, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) {
  Core& core = model_ ? *model_ : plant;
  const Indices& single = core.tree.single_dof;
  for (int k : fixed_q)
    if (!std::binary_search(single.begin(), single.end(), k)) return false;
  if (core.q != fixed_q) return false;
  const bool has_free_roots = !core.tree.roots.empty();
  const int n = core.n, d = core.d, m = core.constraints.closure.rows;
  const bool uses_own_velocity = model_ && !actual_;  // rho q_dot of its own model
  core.compute_rho(), core.compute_D_tree();
  const Vector v1 = uses_own_velocity ? Vector(core.rho * (r_ + v_)) : plant.v_tree, v2 = core.rho * v_;
  core.compute_J_dot(v1);
  const Matrix J = core.constraints.J(), &rho = core.rho;
  // Compute the z rows of x from its q rows, so that J x = -residual.
  const auto complete_dependent = [&](const Matrix& residual, Matrix& x) {
    Vector step(n), total_residual(m);
    for (Eigen::Index k = 0; k < x.cols(); ++k) {
      for (int i : core.z) x(i, k) = 0.0;
      total_residual = residual.col(k) + J * x.col(k);
      core.closure_step_in_z(total_residual, step);
      x.col(k) += step;
    }
  };
  Matrix a = Matrix::Zero(n, 1);
  for (int k = 0; k < d; ++k) a(fixed_q[k], 0) = a_(k);
  Vector residual = core.constraints.J_dot * v2;
  if (has_free_roots) core.compute_J_dot(v2), residual = (residual + core.constraints.J_dot * v1) / 2;
  complete_dependent(residual, a);
  const Vector zero_velocity = Vector::Zero(n), zero_multipliers = Vector::Zero(m);
  const auto differentiate = [&](In v, In a_there, In lambda, bool inertial) {
    core.derivatives.compute(core.q_tree, v, a_there, lambda, inertial);
    return &core.derivatives;
  };
  const auto* by = differentiate(v1 + v2, 2 * a, zero_multipliers, true);
  Matrix force_q = by->force_by_q / 4, row_q = by->row_by_q / 4, plus = by->force_by_v / 4, row_plus = by->row_by_v / 4;
  by = differentiate(v1 - v2, -2 * a, zero_multipliers, true);
  force_q -= by->force_by_q / 4, row_q -= by->row_by_q / 4;
  const Matrix force_1 = plus - by->force_by_v / 4, force_2 = plus + by->force_by_v / 4;
  const Matrix row_1 = row_plus - by->row_by_v / 4, row_2 = row_plus + by->row_by_v / 4;
  Vector inertia_force(n), m_tree(n);
  core.multiply_D_tree(a.col(0), inertia_force);
  Vector other_half = Vector::Zero(n);
  if (has_free_roots) core.set_velocity(v2), core.compute_coriolis(), core.multiply_C_tree(v1, other_half);
  core.set_velocity(v1), core.compute_coriolis();
  core.multiply_C_tree(v2, m_tree);
  if (has_free_roots) m_tree = (m_tree + other_half) / 2;
  m_tree += inertia_force + core.h_tree;
  Vector u(d), lambda(m);
  core.multiply_rho_transposed(m_tree, u);
  for (int k = 0; k < d; ++k) m_tree(fixed_q[k]) -= u(k);
  core.minimum_norm_multipliers(m_tree, lambda);
  by = differentiate(zero_velocity, zero_velocity, lambda, false);
  force_q += by->force_by_q;
  Matrix q_selection = Matrix::Zero(d, n);  // selects q from q'
  for (int k = 0; k < d; ++k) q_selection(k, fixed_q[k]) = 1.0;
  const auto dependent_derivative = [&](const Matrix& of_q, const Matrix& residual) {
    Matrix x = Matrix::Zero(n, n);
    for (int k = 0; k < d; ++k) x.row(fixed_q[k]) = of_q.row(k);
    complete_dependent(residual, x);
    return x;
  };
  const Matrix zero_residual = Matrix::Zero(m, n), zero_rate = Matrix::Zero(d, n);
  Matrix rate_by_q;  // derivative of J v1 and J v2 with respect to q'
  core.constraint_rate_derivative(v1, rate_by_q);
  const Matrix v1_q = uses_own_velocity ? dependent_derivative(zero_rate, rate_by_q) : Matrix(Matrix::Zero(n, n));
  const Matrix v1_v =
      uses_own_velocity ? dependent_derivative(q_selection, zero_residual) : Matrix(Matrix::Identity(n, n));
  core.constraint_rate_derivative(v2, rate_by_q);
  const Matrix v2_q = dependent_derivative(-Lambda_ * q_selection, rate_by_q);
  const Matrix a_q = dependent_derivative(zero_rate, row_q + row_1 * v1_q + row_2 * v2_q);
  const Matrix a_v = dependent_derivative(-Lambda_ * q_selection, row_1 * v1_v);
  Matrix force_by_q_total = force_q + force_1 * v1_q + force_2 * v2_q, force_by_v_total = force_1 * v1_v;
  for (int k = 0; k < n; ++k) {
    core.multiply_D_tree(a_q.col(k), inertia_force), force_by_q_total.col(k) += inertia_force;
    core.multiply_D_tree(a_v.col(k), inertia_force), force_by_v_total.col(k) += inertia_force;
  }
  by_q = rho.transpose() * force_by_q_total - K_D_ * Lambda_ * q_selection;
  by_v = rho.transpose() * force_by_v_total - K_D_ * q_selection;
  core.set_velocity(v1), core.compute_J_dot(v1);
  return by_q.allFinite() && by_v.allFinite();
}

// Lambda enters through v, a and r = q_dot - v.
void TrackingController::gain_derivative(const MeasuredState& at, const Matrix& Lambda, const Matrix& K_D,
                                         Out derivative) {
  Core& core = model_ ? *model_ : at.core;
  core.compute_D(), core.compute_coriolis();
  const Vector of_v = Lambda * e_, of_a = Lambda * e_dot_;
  core.multiply_C(of_v, product_);
  derivative = -product_ - core.D * of_a - K_D_ * of_v - K_D * r_;
}

}  // namespace ckc
