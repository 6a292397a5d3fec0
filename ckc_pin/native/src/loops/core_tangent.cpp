// The tangent space of the closure: eq. 1's acceleration by projection on it, and steps that close the loops.
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "loops/core.hpp"
#include "loops/compiled_terms.hpp"

namespace ckc {

// Relative size of the last pivot of J at which its rank counts as lost; and below which the metric of D' is given up.
constexpr double singular = 1e-12, weak = 1e-3;
// Of phi_z's pivots, and of rho: where the tangent basis' partition is as good as any. A new one has to be better.
constexpr double sound = 1e-2, steep = 4.0, better = 3.0;
// Of the forces: what rounding makes of them on the way to an acceleration.
constexpr double acceleration_digits = 1e-13;

// tangent_ and x_ of a partition whose z follow its q closely, J being far from a loss of rank.
bool Core::basis_by_partition() {
  if (basis_at_ != sets) {
    basis_at_ = -1;
    basis_.compute(rows.J, basis_z_);
    free_ = basis_q_;
    if (!(basis_.pivot_ratio() > sound)) return false;
    for (int k = 0; k < n - rank; ++k) {
      residual_ = -rows.J.col(basis_q_[k]);
      basis_.solve(residual_, z_);
      tangent_.col(k).setZero();
      tangent_(basis_q_[k], k) = 1.0;
      for (size_t i = 0; i < basis_z_.size(); ++i) tangent_(basis_z_[i], k) = z_(i);
    }
    if (!(steepness() < steep)) return false;
    basis_at_ = sets;
  }
  basis_.solve(negative_, z_);
  for (size_t i = 0; i < basis_z_.size(); ++i) x_(basis_z_[i]) = z_(i);
  return true;
}

// The largest entry of the tangent basis, free of units: each column has a one.
double Core::steepness() const {
  double largest = 0.0;
  for (int k = 0; k < n - rank; ++k)
    for (int i = 0; i < n; ++i)
      largest = std::max(largest, std::abs(tangent_(i, k)) / scales.columns(i) * scales.columns(free_[k]));
  return largest;
}

// Take the pivoting's columns for the tangent basis from now on, if they are other ones and good for a while.
void Core::repartition() {
  if (!(steepness() < better)) return;
  const auto& order = qr_.colsPermutation().indices();
  pivots_.assign(order.data(), order.data() + rank);
  std::sort(pivots_.begin(), pivots_.end());
  if (pivots_ == basis_z_) return;
  basis_z_ = pivots_;
  basis_q_.assign(order.data() + rank, order.data() + n);
  basis_.shape(rows.closure.rows, rank, rows.pattern_of(basis_z_, n));
}

// J P = Q [R S], and the columns that the pivoting left over are the freedoms; slides in units of the mechanism's size.
bool Core::basis_by_pivoting(double least) {
  qr_.compute(rows.J * scales.columns.asDiagonal());
  const auto& r = qr_.matrixQR();
  const auto& order = qr_.colsPermutation().indices();
  if (rank && !(std::abs(r(rank - 1, rank - 1)) > least * std::abs(r(0, 0)))) return false;
  turned_ = negative_;
  for (int k = 0; k < rank; ++k) {  // Q^T
    const auto v = r.col(k).tail(turned_.size() - k - 1);
    const double along = qr_.hCoeffs()(k) * (turned_(k) + v.dot(turned_.tail(v.size())));
    turned_(k) -= along;
    turned_.tail(v.size()) -= along * v;
  }
  tangent_.setZero();
  for (int i = rank - 1; i >= 0; --i) {  // -R^-1 of it and of S, by rows
    double value = turned_(i);
    for (int k = i + 1; k < rank; ++k) value -= r(i, k) * x_(order(k));
    x_(order(i)) = value / r(i, i);
    for (int j = 0; j < n - rank; ++j) {
      double entry = -r(i, rank + j);
      for (int k = i + 1; k < rank; ++k) entry -= r(i, k) * tangent_(order(k), j);
      tangent_(order(i), j) = entry / r(i, i);
    }
  }
  for (int j = 0; j < n - rank; ++j) tangent_(free_[j] = order(rank + j), j) = 1.0;
  x_.array() *= scales.columns.array();
  for (int j = 0; j < n - rank; ++j) tangent_.col(j).array() *= scales.columns.array() / scales.columns(free_[j]);
  return true;
}

bool Core::tangent_basis(In residual, double least) {
  jacobian();
  x_.setZero();
  negative_ = -residual;  // which may be residual_
  if (!rows.closure.rows)
    tangent_.setIdentity();
  else if (!basis_by_partition()) {
    if (!basis_by_pivoting(least)) return false;
    repartition();
  }
  return true;
}

void Core::tangent_inertia() {
  if (inertia_at_ == sets && basis_at_ == sets) return;
  tree_inertia();
  if (dense_)
    D_tangent_.noalias() = D_tree().selfadjointView<Eigen::Upper>() * tangent_;
  else
    for (int k = 0; k < n - rank; ++k) D_times(tangent_.col(k), D_tangent_.col(k));
  square_.noalias() = tangent_.transpose() * D_tangent_;
  square_factor_.compute(square_);
  inertia_at_ = basis_at_;
}

void Core::with_force(In force, Out x) {
  small_b_.noalias() = tangent_.transpose() * force;
  square_factor_.solve(small_b_, small_);
  x = x_;
  for (int k = 0; k < n - rank; ++k) x += small_(k) * tangent_.col(k);
}

void Core::z_step(In residual, Out x) {
  phi_z.solve(residual, z_);
  x.setZero();
  for (size_t k = 0; k < z.size(); ++k) x(z[k]) = -z_(k);
}

bool Core::step_onto_closure(In residual, Out x) {
  return (written && written->closing_step(q_tree, residual, x)) || shortest_step(residual, x);
}

bool Core::closing_step(In residual, Out x) {
  if (written && written->closing_step(q_tree, residual, x)) return true;
  if (!tangent_basis(residual, weak)) return shortest_step(residual, x);
  tangent_inertia();
  D_times(x_, y_);
  y_ = -y_;
  with_force(y_, x);
  return true;
}

bool Core::shortest_step(In residual, Out x) {
  if (!tangent_basis(residual, singular)) return false;
  square_.noalias() = tangent_.transpose() * tangent_;
  square_factor_.compute(square_), inertia_at_ = -1;
  y_ = -x_;
  with_force(y_, x);
  return true;
}

const Matrix* Core::tangent() {
  residual_.setZero();
  return tangent_basis(residual_, singular) ? &tangent_ : nullptr;
}

void Core::particular(In residual, Out x) {
  tangent_basis(residual, singular);
  x = x_;
}

bool Core::dae_acceleration(In u_tree, In correction, Out acceleration) {
  if (written_acceleration(q_tree, v_tree, u_tree, correction, acceleration)) return true;
  bias();
  residual_ = J_dot_v + correction;
  if (!tangent_basis(residual_, singular)) return false;
  if (!uses_levels_ || !project_by_levels(u_tree, acceleration)) project(u_tree, acceleration);
  return true;
}

void Core::project(In u_tree, Out a) {
  tangent_inertia();
  D_times(x_, y_);
  y_ = u_tree - bias_tree - y_ + damping_tree;
  with_force(y_, a);
}

bool Core::basis_for_check() {
  jacobian(), bias();
  negative_ = -J_dot_v, x_.setZero();
  basis_at_ = -1;  // the partition's basis is computed again when it is needed
  if (rows.closure.rows) return basis_by_pivoting(singular);
  tangent_.setIdentity();
  std::iota(free_.begin(), free_.end(), 0);
  return true;
}

// Relative to what the forces would give where none cancels another one: near an equilibrium accelerations are rounding.
double Core::off(In a, In right) {
  const Vector& units = scales.columns;
  double largest = right.cwiseQuotient(units).lpNorm<Eigen::Infinity>();
  for (int k = 0; k < n - rank; ++k) {
    const auto along = tangent_.col(k);
    const double inertia = along.cwiseAbs2().dot(D_tree().diagonal());
    const double alone = inertia > 0.0 ? along.cwiseAbs().dot(y_.cwiseAbs()) / inertia : 0.0;
    largest = std::max(largest, alone * along.cwiseQuotient(units).lpNorm<Eigen::Infinity>());
  }
  const double difference = (a - right).cwiseQuotient(units).lpNorm<Eigen::Infinity>();
  if (!std::isfinite(difference)) return std::numeric_limits<double>::infinity();
  return difference > 0.0 ? difference / largest : 0.0;
}

double Core::rounding_of_elimination(In u_tree) {
  Vector compiled(n), right(n);
  residual_.setZero();
  if (!written->eliminate(q_tree, v_tree, u_tree, residual_, compiled) || !basis_for_check()) return 0.0;
  project(u_tree, right);
  if (!uses_levels_) return off(compiled, right);
  Vector by_levels(n);
  const Vector forces = y_;
  if (project_by_levels(u_tree, by_levels)) right = by_levels;
  y_ = forces;
  return off(compiled, right);
}

double Core::rounding_of_projection(In u_tree) {
  Vector plain(n), right(n);
  if (!basis_for_check()) return 0.0;
  project(u_tree, plain);
  const Vector forces = y_;
  if (!project_by_levels(u_tree, right)) return 0.0;
  y_ = forces;
  return off(plain, right);
}

bool Core::eq_1(In force, In correction, Out a) {
  if (!dae_acceleration(force, correction, a)) return false;
  if (joints.locked.empty()) return true;
  if (!responses(joints.locked, responses_)) return false;
  acceleration_rounding(joints.locked, responses_, force, a, rounding_);
  joints.hold(responses_, a);
  return true;
}

// Generalized forces are rounded as the largest parts that cancel in them: those that would accelerate a joint's own
// inertia as the fastest coordinate accelerates, as gravity does, or as the velocities turn the bodies.
void Core::acceleration_rounding(const Indices& at, const Matrix& columns, In force, In a, Vector& bound) {
  const Vector& reach = joints.table.reach;
  const double fastest = v_tree.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  const double pace = std::max({a.cwiseQuotient(reach).lpNorm<Eigen::Infinity>(), fastest * fastest,
                                tree.field().head<3>().norm() / joints.table.size});
  const Matrix& D = D_tree();
  effort_bound_ = force.cwiseAbs();
  for (int k = 0; k < n; ++k) effort_bound_(k) += D(k, k) * reach(k) * pace;
  bound.noalias() = columns.cwiseAbs().transpose() * effort_bound_;
  bound *= acceleration_digits;
  for (size_t i = 0; i < at.size(); ++i)  // a body that rests but for rounding turns at that rate
    bound(static_cast<Eigen::Index>(i)) += reach(at[i]) * joints.rate_rounding * joints.rate_rounding;
  bound *= joints.patience;
}

bool Core::responses(const Indices& at, Matrix& columns) {
  columns.resize(n, static_cast<Eigen::Index>(at.size()));
  residual_.setZero();
  if (!tangent_basis(residual_, singular)) return false;
  tangent_inertia();
  for (size_t k = 0; k < at.size(); ++k) {
    y_.setUnit(at[k]);
    with_force(y_, columns.col(k));
  }
  return true;
}

void Core::multipliers(In force, Out lambda) {
  if (!rows.closure.rows) return;
  jacobian();
  transposed_.setThreshold(scales.rank);
  transposed_.compute(scales.columns.asDiagonal() * rows.J.transpose() * scales.rows.asDiagonal());
  lambda = scales.rows.cwiseProduct(transposed_.solve(scales.columns.cwiseProduct(force)));
}

bool Core::differentiate(In u_tree, In acceleration) {
  bias(), tree_inertia();
  D_times(acceleration, effort_);
  effort_ += bias_tree - damping_tree - u_tree;
  lambda_.setZero();
  multipliers(effort_, lambda_);
  derivatives.compute(q_tree, v_tree, acceleration, lambda_);
  return derivatives.force_by_q.allFinite() && derivatives.row_by_q.allFinite();
}

bool Core::respond(const Matrix& force, const Matrix& residual, Matrix& change) {
  change.resize(n, force.cols());
  for (Eigen::Index k = 0; k < force.cols(); ++k) {
    residual_ = residual.col(k);
    if (!tangent_basis(residual_, singular)) return false;
    if (!k) tangent_inertia();
    D_times(x_, y_);
    y_ = force.col(k) - y_;
    with_force(y_, change.col(k));
  }
  return true;
}

bool Core::slopes(In q_at, In v, In correction, Vector& force, Matrix& u_by_q, Matrix& u_by_v, Vector& a, Matrix& by_q,
                  Matrix& by_v, Matrix* by_u) {
  joints.add_friction(v, force);
  if (joints.smooth()) {
    Vector slope = Vector::Zero(n);
    joints.add_slopes(v, slope);
    if (!u_by_v.size()) u_by_v.setZero(n, n);
    u_by_v.diagonal() += slope;
  }
  a.resize(n);
  const bool locked = !joints.locked.empty();
  if (locked) {
    set_velocity(v);
    if (!eq_1(force, correction, a)) return false;
    for (size_t i = 0; i < joints.locked.size(); ++i) force(joints.locked[i]) += joints.forces()(static_cast<Eigen::Index>(i));
  }
  Matrix& of_u = by_u ? *by_u : by_u_;
  if (written && correction.isZero(0) && written->jacobian(q_at, v, force, by_state_, of_u)) {
    const int nq = tree.nq;
    by_v = by_state_.bottomRightCorner(n, n);
    if (nq == n) {
      by_q = by_state_.bottomLeftCorner(n, n);
    } else {
      by_q.resize(n, n);
      Vector move(nq);
      for (int k = 0; k < n; ++k) {
        tree.configuration_rate(q_at, Vector::Unit(n, k), move);
        by_q.col(k).noalias() = by_state_.bottomLeftCorner(n, nq) * move;
      }
    }
    if (u_by_q.size()) by_q.noalias() += of_u * u_by_q;
    if (u_by_v.size()) by_v.noalias() += of_u * u_by_v;
  } else {
    if (q_tree != q_at) set(q_at, true);
    set_velocity(v);
    if (!locked && !dae_acceleration(force, correction, a)) return false;
    if (!differentiate(force, a)) return false;
    const Derivatives& by = derivatives;
    const auto changed = [this](const Matrix& u_part, const Matrix& tree_part) -> const Matrix& {
      change_ = -tree_part;
      if (u_part.size()) change_ += u_part;
      return change_;
    };
    if (!respond(changed(u_by_q, by.force_by_q), by.row_by_q, by_q) ||
        !respond(changed(u_by_v, by.force_by_v), by.row_by_v, by_v))
      return false;
    if (by_u && !respond(Matrix::Identity(n, n), Matrix::Zero(rows.closure.rows, n), of_u)) return false;
  }
  if (locked) {
    Vector back(n);
    for (Matrix* by : {&by_q, &by_v, by_u})
      for (int k = 0; by && k < n; ++k) {
        joints.back(responses_, by->col(k), back);
        by->col(k) += back;
      }
  }
  return finite(by_q.reshaped()) && finite(by_v.reshaped());
}

bool Core::written_acceleration(In q_tree, In v, In u_tree, In correction, Out acceleration) const {
  return written && written->acceleration(q_tree, v, u_tree, correction, acceleration);
}

}  // namespace ckc
