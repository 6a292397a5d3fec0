#include "loops/linearization.hpp"

#include <Eigen/LU>
#include <Eigen/SVD>

namespace ckc {

// Coordinates are a valid chart if their rows of an orthonormal tangent basis have a larger smallest singular value.
constexpr double min_chart_singular_value = 1e-5;
constexpr double min_phi_z_pivot = 1e-2;  // pivot ratio of phi_z above which q is a valid chart
// A coordinate is fixed by locked ones if its row of the tangent basis is smaller, relative to the largest entry.
constexpr double locked_motion_tolerance = 1e-9;

Linearization::Linearization(std::unique_ptr<Core> core_, Matrix transmission_)
    : core(std::move(core_)), transmission(std::move(transmission_)) {
  acceleration.a.setZero(core->n), residual_.setZero(core->constraints.closure.rows);
}

bool Linearization::compute(In q_tree, In v, In u_tree, const Indices& locked, const Matrix& u_by_q,
                            In correction) {
  Core& c = *core;
  c.joints.locked = locked;
  c.set_configuration(q_tree, true), c.set_velocity(v);
  u_tree_ = u_tree, u_by_q_ = u_by_q, correction_ = correction;
  force_ = {u_tree, u_by_q, {}};
  if (!c.acceleration_derivatives(c.q_tree, v, correction_, force_, acceleration, true) || !find_basis()) return false;
  compute_velocity_dependence(v), assemble_A_B(v);
  return true;
}

Linearization::Pivoted Linearization::factorize_with_locked_rows() const {
  Core& c = *core;
  const Indices& locked = c.joints.locked;
  const Eigen::Index m = c.constraints.closure.rows;
  Matrix rows = Matrix::Zero(m + static_cast<Eigen::Index>(locked.size()), c.n);
  rows.topRows(m) = c.scales.rows.asDiagonal() * c.constraints.J() * c.scales.columns.asDiagonal();
  for (size_t i = 0; i < locked.size(); ++i) rows(m + static_cast<Eigen::Index>(i), locked[i]) = 1.0;
  Pivoted qr;
  qr.setThreshold(c.scales.rank);
  qr.compute(rows);
  return qr;
}

bool Linearization::find_basis() {
  Core& c = *core;
  uses_rho_ = false;
  if (!c.joints.locked.empty()) return c.compute_J(), set_basis_from(factorize_with_locked_rows()), true;
  if (c.rank) {
    c.factorize_phi_z();
    uses_rho_ = c.phi_z.pivot_ratio() > min_phi_z_pivot;
  }
  if (uses_rho_) return c.compute_rho(), T = c.rho, coordinates = c.q, true;
  const Matrix* tangent = c.compute_tangent_basis();
  if (!tangent) return false;
  T = *tangent, choose_coordinates(c.basis_coordinates());
  return true;
}

// J P = Q [R S]. The columns without a pivot are the freedoms.
void Linearization::set_basis_from(const Pivoted& qr) {
  const Vector& columns = core->scales.columns;
  const Eigen::Index n = core->n, rank = qr.rank();
  const auto& order = qr.colsPermutation().indices();
  Matrix dependent = qr.matrixQR().topRightCorner(rank, n - rank);
  qr.matrixQR().topLeftCorner(rank, rank).triangularView<Eigen::Upper>().solveInPlace(dependent);
  Indices free;
  T.setZero(n, n - rank);
  for (Eigen::Index j = 0; j < n - rank; ++j) {
    free.push_back(order(rank + j));
    for (Eigen::Index i = 0; i < rank; ++i)
      T(order(i), j) = -dependent(i, j) * columns(order(i)) / columns(free.back());
    T(free.back(), j) = 1.0;
  }
  for (int k : core->joints.locked) T.row(k).setZero();
  choose_coordinates(free);
}

// Use q without its locked coordinates as states. If they are no valid chart, use the coordinates of the basis.
void Linearization::choose_coordinates(const Indices& free) {
  coordinates.clear();
  const double min_entry = locked_motion_tolerance * T.lpNorm<Eigen::Infinity>();
  for (int k : core->q)
    if (core->joints.locked.empty() || T.row(k).lpNorm<Eigen::Infinity>() > min_entry) coordinates.push_back(k);
  if (coordinates == free) return;
  const auto d = static_cast<Eigen::Index>(free.size());
  if (static_cast<Eigen::Index>(coordinates.size()) == d) {
    const auto chart_rows = [&](const Matrix& basis) {
      Matrix part(d, d);
      for (Eigen::Index i = 0; i < d; ++i) part.row(i) = basis.row(coordinates[i]);
      return part;
    };
    const Matrix free_of_units = core->scales.columns.cwiseInverse().asDiagonal() * T;
    const Matrix orthonormal_basis = free_of_units.householderQr().householderQ() * Matrix::Identity(core->n, d);
    if (chart_rows(orthonormal_basis).jacobiSvd().singularValues()(d - 1) > min_chart_singular_value) {
      const Matrix rotated = chart_rows(T).partialPivLu().transpose().solve(Matrix(T.transpose()));
      T = rotated.transpose();
      for (Eigen::Index i = 0; i < d; ++i) T.row(coordinates[i]).setZero(), T(coordinates[i], i) = 1.0;
      return;
    }
  }
  coordinates = free;
}

// J V = -(d (J v') / d q') T, with zero rows for the states' own coordinates.
void Linearization::compute_velocity_dependence(In v) {
  Core& c = *core;
  V.setZero(T.rows(), T.cols());
  if (v.isZero(0) || !c.constraints.closure.rows) return;
  c.constraint_rate_derivative(v, rate_by_q_);
  const Eigen::Index d = T.cols(), m = rate_by_q_.rows();
  if (c.joints.locked.empty()) {
    for (Eigen::Index k = 0; k < d; ++k) {
      residual_ = rate_by_q_.lazyProduct(T.col(k));
      uses_rho_ ? c.closure_step_in_z(residual_, V.col(k)) : c.particular_solution(residual_, V.col(k));
    }
    if (uses_rho_) return;
  } else {
    const Pivoted qr = factorize_with_locked_rows();
    const Eigen::Index rank = qr.rank();
    Matrix residual = Matrix::Zero(qr.rows(), d);
    residual.topRows(m) = c.scales.rows.asDiagonal() * (rate_by_q_ * T);
    residual.applyOnTheLeft(qr.householderQ().adjoint());
    Matrix solution = residual.topRows(rank);
    qr.matrixQR().topLeftCorner(rank, rank).triangularView<Eigen::Upper>().solveInPlace(solution);
    for (Eigen::Index i = 0; i < rank; ++i) {
      const auto k = qr.colsPermutation().indices()(i);
      V.row(k) = -c.scales.columns(k) * solution.row(i);
    }
    for (int k : c.joints.locked) V.row(k).setZero();
  }
  Matrix of_states(d, d);
  for (Eigen::Index i = 0; i < d; ++i) of_states.row(i) = V.row(coordinates[i]);
  V.noalias() -= T * of_states;
  for (int k : coordinates) V.row(k).setZero();
}

void Linearization::assemble_A_B(In v) {
  const Eigen::Index n = T.rows(), d = T.cols(), motors = transmission.rows();
  A.setZero(2 * d, 2 * d), B.setZero(2 * d, motors);
  for (Eigen::Index i = 0; i < d; ++i) {
    const int row = coordinates[i];
    A(i, d + i) = 1.0;
    for (Eigen::Index j = 0; j < d; ++j) {
      double by_position = 0.0, by_rate = 0.0;
      for (Eigen::Index k = 0; k < n; ++k)
        by_position += acceleration.by_q(row, k) * T(k, j) + acceleration.by_v(row, k) * V(k, j),
            by_rate += acceleration.by_v(row, k) * T(k, j);
      A(d + i, j) = by_position, A(d + i, d + j) = by_rate;
    }
    for (Eigen::Index j = 0; j < motors; ++j) {
      double by_motor = 0.0;
      for (Eigen::Index k = 0; k < n; ++k) by_motor += acceleration.by_u(row, k) * transmission(j, k);
      B(d + i, j) = by_motor;
    }
  }
  if (core->tree.roots.empty()) return;
  const Matrix rotated = core->tree.bracket_matrix(v) * T;
  for (Eigen::Index i = 0; i < d; ++i) A.row(i).head(d) -= rotated.row(coordinates[i]);
}

// D' da + dR = J^T dlambda with R = D' a + C' v' + h' minus applied forces and J^T lambda.
void Linearization::solve_multipliers() {
  Core& c = *core;
  const Indices& locked = c.joints.locked;
  const Eigen::Index n = c.n, m = c.constraints.closure.rows;
  if (locked.empty()) c.dae_acceleration(force_.value, correction_, acceleration.a);
  lambda.setZero(m);
  for (Matrix* x : {&lambda_q, &lambda_v, &lambda_u}) x->setZero(m, n);
  if (!m) return;
  c.compute_J(), c.compute_bias(), c.compute_D_tree();
  Matrix J = Matrix::Zero(m + static_cast<Eigen::Index>(locked.size()), n);
  J.topRows(m) = c.constraints.J();
  for (size_t i = 0; i < locked.size(); ++i) J(m + static_cast<Eigen::Index>(i), locked[i]) = 1.0;
  const Eigen::Index rank = n - T.cols();  // independent of rounding in redundant rows
  const Eigen::BDCSVD<Matrix> svd(J, Eigen::ComputeThinU | Eigen::ComputeThinV);
  const Matrix inverse = svd.matrixV().leftCols(rank) * svd.singularValues().head(rank).cwiseInverse().asDiagonal() *
                         svd.matrixU().leftCols(rank).transpose();
  const auto D_times = [&](const Matrix& x) {
    Matrix product(n, x.cols());
    for (Eigen::Index k = 0; k < x.cols(); ++k) c.multiply_D_tree(x.col(k), product.col(k));
    return product;
  };
  Vector residual = u_tree_, friction_derivative = Vector::Zero(n), v = c.v_tree;
  c.joints.add_friction_force(v, residual), c.joints.add_friction_derivative(v, friction_derivative);
  residual = D_times(acceleration.a) + c.bias_tree - c.damping_tree - residual;
  const Vector all_multipliers = inverse.transpose() * residual;
  lambda = all_multipliers.head(m);
  const Matrix of_q = D_times(acceleration.by_q), of_v = D_times(acceleration.by_v), of_u = D_times(acceleration.by_u);
  c.derivatives.compute(c.q_tree, v, acceleration.a, lambda);
  const Matrix minimum_norm = inverse.leftCols(m).transpose();
  lambda_q = minimum_norm * (of_q + c.derivatives.force_by_q);
  if (u_by_q_.size()) lambda_q -= minimum_norm * u_by_q_;
  lambda_v = minimum_norm * (of_v + c.derivatives.force_by_v - Matrix(friction_derivative.asDiagonal()));
  lambda_u = minimum_norm * (of_u - Matrix::Identity(n, n));
  if (rank == J.rows()) return;
  // the term that keeps lambda minimum-norm while the range of J rotates
  c.constraint_rate_derivative(inverse * all_multipliers, rate_by_q_);
  Matrix rotated = Matrix::Zero(J.rows(), n);
  rotated.topRows(m) = rate_by_q_;
  lambda_q += (rotated - J * (inverse * rotated)).topRows(m);
  c.set_velocity(v);
}

}  // namespace ckc
