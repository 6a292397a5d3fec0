#include "loops/linearization.hpp"

#include <Eigen/LU>
#include <Eigen/SVD>

namespace ckc {

constexpr double poor = 1e-5;      // least of what a motion of size one moves the coordinates: below that they are no chart
constexpr double sound = 1e-2;      // of phi_z's pivots: q is as good a chart as any
constexpr double at_rest = 1e-9;   // of a tangent basis' largest entry: a coordinate that locked ones leave no motion

Plant::Plant(std::unique_ptr<Core> core_, Matrix turns_) : core(std::move(core_)), turns(std::move(turns_)) {
  a.setZero(core->n), residual_.setZero(core->rows.closure.rows);
}

bool Plant::compute(In q_tree, In v, In u_tree, const Indices& locked) {
  Core& c = *core;
  c.joints.locked = locked;
  c.set(q_tree, true), c.set_velocity(v);
  force_ = given_ = u_tree;
  u_by_q_.resize(0, 0), u_by_v_.resize(0, 0), residual_.setZero();
  if (!c.slopes(c.q_tree, v, residual_, force_, u_by_q_, u_by_v_, a, a_q, a_v, &a_u) || !basis()) return false;
  follow(v), assemble(v);
  return true;
}

Plant::Pivoted Plant::with_locked() const {
  const Core& c = *core;
  const Indices& locked = c.joints.locked;
  const Eigen::Index m = c.rows.closure.rows;
  Matrix rows = Matrix::Zero(m + static_cast<Eigen::Index>(locked.size()), c.n);
  rows.topRows(m) = c.scales.rows.asDiagonal() * c.rows.J * c.scales.columns.asDiagonal();
  for (size_t i = 0; i < locked.size(); ++i) rows(m + static_cast<Eigen::Index>(i), locked[i]) = 1.0;
  Pivoted qr;
  qr.setThreshold(c.scales.rank);
  qr.compute(rows);
  return qr;
}

bool Plant::basis() {
  Core& c = *core;
  own_ = false;
  if (!c.joints.locked.empty()) return c.jacobian(), basis_of(with_locked()), true;
  if (c.rank) {
    c.factor();
    own_ = c.phi_z.pivot_ratio() > sound;
  }
  if (own_) return c.reduce(), T = c.rho, at = c.q, true;
  const Matrix* tangent = c.tangent();
  if (!tangent) return false;
  T = *tangent, choose(c.free());
  return true;
}

// J P = Q [R S]: the columns that the pivoting left over are the freedoms.
void Plant::basis_of(const Pivoted& qr) {
  const Vector& columns = core->scales.columns;
  const Eigen::Index n = core->n, rank = qr.rank();
  const auto& order = qr.colsPermutation().indices();
  Matrix follows = qr.matrixQR().topRightCorner(rank, n - rank);
  qr.matrixQR().topLeftCorner(rank, rank).triangularView<Eigen::Upper>().solveInPlace(follows);
  Indices free;
  T.setZero(n, n - rank);
  for (Eigen::Index j = 0; j < n - rank; ++j) {
    free.push_back(order(rank + j));
    for (Eigen::Index i = 0; i < rank; ++i) T(order(i), j) = -follows(i, j) * columns(order(i)) / columns(free.back());
    T(free.back(), j) = 1.0;
  }
  for (int k : core->joints.locked) T.row(k).setZero();
  choose(free);
}

// The mechanism's own q, less what is locked, or where that is no chart what the basis is of.
void Plant::choose(const Indices& free) {
  at.clear();
  const double least = at_rest * T.lpNorm<Eigen::Infinity>();
  for (int k : core->q)
    if (core->joints.locked.empty() || T.row(k).lpNorm<Eigen::Infinity>() > least) at.push_back(k);
  if (at == free) return;
  const auto d = static_cast<Eigen::Index>(free.size());
  if (static_cast<Eigen::Index>(at.size()) == d) {
    const auto of_chart = [&](const Matrix& basis) {
      Matrix part(d, d);
      for (Eigen::Index i = 0; i < d; ++i) part.row(i) = basis.row(at[i]);
      return part;
    };
    const Matrix free_of_units = core->scales.columns.cwiseInverse().asDiagonal() * T;
    const Matrix motions = free_of_units.householderQr().householderQ() * Matrix::Identity(core->n, d);
    if (of_chart(motions).jacobiSvd().singularValues()(d - 1) > poor) {
      const Matrix turned = of_chart(T).partialPivLu().transpose().solve(Matrix(T.transpose()));
      T = turned.transpose();
      for (Eigen::Index i = 0; i < d; ++i) T.row(at[i]).setZero(), T(at[i], i) = 1.0;
      return;
    }
  }
  at = free;
}

// J V = -(d (J v') / d q') T, of others than those coordinates.
void Plant::follow(In v) {
  Core& c = *core;
  V.setZero(T.rows(), T.cols());
  if (v.isZero(0) || !c.rows.closure.rows) return;
  c.closure_rate(v, opened_);
  const Eigen::Index d = T.cols(), m = opened_.rows();
  if (c.joints.locked.empty()) {
    for (Eigen::Index k = 0; k < d; ++k) {
      residual_ = opened_.lazyProduct(T.col(k));
      own_ ? c.z_step(residual_, V.col(k)) : c.particular(residual_, V.col(k));
    }
    if (own_) return;
  } else {
    const Pivoted qr = with_locked();
    const Eigen::Index rank = qr.rank();
    Matrix lacking = Matrix::Zero(qr.rows(), d);
    lacking.topRows(m) = c.scales.rows.asDiagonal() * (opened_ * T);
    lacking.applyOnTheLeft(qr.householderQ().adjoint());
    Matrix moved = lacking.topRows(rank);
    qr.matrixQR().topLeftCorner(rank, rank).triangularView<Eigen::Upper>().solveInPlace(moved);
    for (Eigen::Index i = 0; i < rank; ++i) {
      const auto k = qr.colsPermutation().indices()(i);
      V.row(k) = -c.scales.columns(k) * moved.row(i);
    }
    for (int k : c.joints.locked) V.row(k).setZero();
  }
  Matrix of_states(d, d);
  for (Eigen::Index i = 0; i < d; ++i) of_states.row(i) = V.row(at[i]);
  V.noalias() -= T * of_states;
  for (int k : at) V.row(k).setZero();
}

void Plant::assemble(In v) {
  const Eigen::Index n = T.rows(), d = T.cols(), motors = turns.rows();
  A.setZero(2 * d, 2 * d), B.setZero(2 * d, motors);
  for (Eigen::Index i = 0; i < d; ++i) {
    const int row = at[i];
    A(i, d + i) = 1.0;
    for (Eigen::Index j = 0; j < d; ++j) {
      double by_place = 0.0, by_rate = 0.0;
      for (Eigen::Index k = 0; k < n; ++k)
        by_place += a_q(row, k) * T(k, j) + a_v(row, k) * V(k, j), by_rate += a_v(row, k) * T(k, j);
      A(d + i, j) = by_place, A(d + i, d + j) = by_rate;
    }
    for (Eigen::Index j = 0; j < motors; ++j) {
      double by_motor = 0.0;
      for (Eigen::Index k = 0; k < n; ++k) by_motor += a_u(row, k) * turns(j, k);
      B(d + i, j) = by_motor;
    }
  }
  if (core->tree.roots.empty()) return;
  const Matrix turned = core->tree.brackets(v) * T;
  for (Eigen::Index i = 0; i < d; ++i) A.row(i).head(d) -= turned.row(at[i]);
}

// D' da + dR = J^T dlambda with R = D' a + C' v' + h' less what acts and J^T lambda.
void Plant::solve() {
  Core& c = *core;
  const Indices& locked = c.joints.locked;
  const Eigen::Index n = c.n, m = c.rows.closure.rows;
  residual_.setZero();
  if (locked.empty()) c.dae_acceleration(force_, residual_, a);
  lambda.setZero(m);
  for (Matrix* x : {&lambda_q, &lambda_v, &lambda_u}) x->setZero(m, n);
  if (!m) return;
  c.jacobian(), c.bias(), c.tree_inertia();
  Matrix J = Matrix::Zero(m + static_cast<Eigen::Index>(locked.size()), n);
  J.topRows(m) = c.rows.J;
  for (size_t i = 0; i < locked.size(); ++i) J(m + static_cast<Eigen::Index>(i), locked[i]) = 1.0;
  const Eigen::Index rank = n - T.cols();  // whatever rounding makes of rows that the others imply
  const Eigen::BDCSVD<Matrix> svd(J, Eigen::ComputeThinU | Eigen::ComputeThinV);
  const Matrix inverse = svd.matrixV().leftCols(rank) * svd.singularValues().head(rank).cwiseInverse().asDiagonal() *
                         svd.matrixU().leftCols(rank).transpose();
  const auto D_times = [&](const Matrix& x) {
    Matrix product(n, x.cols());
    for (Eigen::Index k = 0; k < x.cols(); ++k) c.D_times(x.col(k), product.col(k));
    return product;
  };
  Vector lacking = given_, slope = Vector::Zero(n), v = c.v_tree;
  c.joints.add_friction(v, lacking), c.joints.add_slopes(v, slope);
  lacking = D_times(a) + c.bias_tree - c.damping_tree - lacking;
  const Vector all = inverse.transpose() * lacking;
  lambda = all.head(m);
  const Matrix of_q = D_times(a_q), of_v = D_times(a_v), of_u = D_times(a_u);
  c.derivatives.compute(c.q_tree, v, a, lambda);
  const Matrix least = inverse.leftCols(m).transpose();
  lambda_q = least * (of_q + c.derivatives.force_by_q);
  lambda_v = least * (of_v + c.derivatives.force_by_v - Matrix(slope.asDiagonal()));
  lambda_u = least * (of_u - Matrix::Identity(n, n));
  if (rank == J.rows()) return;
  // what keeps them the least ones as the range of J turns
  c.closure_rate(inverse * all, opened_);
  Matrix turned = Matrix::Zero(J.rows(), n);
  turned.topRows(m) = opened_;
  lambda_q += (turned - J * (inverse * turned)).topRows(m);
  c.set_velocity(v);
}

}  // namespace ckc
