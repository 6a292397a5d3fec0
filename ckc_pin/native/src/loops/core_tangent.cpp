// The tangent space of the constraint manifold: projection of eq. 1 on it, and steps towards the manifold.
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "loops/articulated_elimination.hpp"
#include "loops/core.hpp"
#include "loops/compiled_terms.hpp"
#include "loops/partition.hpp"
#include "loops/sparse_elimination.hpp"

namespace ckc {

// Last pivot of J, relative to the first: below `rank_lost_pivot` the rank is lost, below the other the metric of D' is
// not used.
constexpr double rank_lost_pivot = 1e-12, min_pivot_for_inertia_metric = 1e-3;
// The tangent basis keeps its partition while the pivot ratio is larger and its entries are smaller than these. A new
// partition has to satisfy the stricter last bound.
constexpr double min_partition_pivot = 1e-2, max_partition_slope = 4.0, max_new_partition_slope = 3.0;
// Accepted rounding error of elimination, relative to that of projection.
constexpr double max_rounding_ratio = 10.0;
// Rounding error of an acceleration, relative to the forces that cause it.
constexpr double acceleration_rounding_factor = 1e-13;

// Compute tangent_ and x_ from the present partition. Fails near a loss of rank or if z moves much faster than q.
bool Core::find_basis_by_partition() {
  if (basis_configuration_ != configuration_count) {
    basis_configuration_ = -1;
    basis_.compute(constraints.J_entries());
    basis_coordinates_ = basis_q_;
    if (!(basis_.pivot_ratio() > min_partition_pivot)) return false;
    for (int k = 0; k < n - rank; ++k) {
      constraints.J_column(basis_q_[k], residual_);
      basis_.solve(residual_, z_);
      tangent_.col(k).setZero();
      tangent_(basis_q_[k], k) = 1.0;
      for (size_t i = 0; i < basis_z_.size(); ++i) tangent_(basis_z_[i], k) = -z_(i);
    }
    if (!(largest_basis_entry() < max_partition_slope)) return false;
    basis_configuration_ = configuration_count;
  }
  basis_.solve(minus_residual_, z_);
  x_.setZero();
  for (size_t i = 0; i < basis_z_.size(); ++i) x_(basis_z_[i]) = z_(i);
  return true;
}

// Largest dimensionless entry of the tangent basis. Each column contains a one.
double Core::largest_basis_entry() const {
  double largest = 0.0;
  for (int k = 0; k < n - rank; ++k)
    for (int i = 0; i < n; ++i)
      largest = std::max(largest, std::abs(tangent_(i, k)) / scales.columns(i) * scales.columns(basis_coordinates_[k]));
  return largest;
}

// Use the coordinates that pivoting has chosen for the tangent basis from now on, if they differ and are well
// conditioned.
void Core::take_pivots_as_partition() {
  if (!(largest_basis_entry() < max_new_partition_slope)) return;
  const auto& order = qr_.colsPermutation().indices();
  pivots_.assign(order.data(), order.data() + rank);
  std::sort(pivots_.begin(), pivots_.end());
  if (pivots_ == basis_z_) return;
  basis_z_ = pivots_;
  basis_q_.assign(order.data() + rank, order.data() + n);
  const auto [pattern, places] = constraints.in_columns(basis_z_);
  basis_.set_pattern(constraints.closure.rows, rank, pattern, places);
}

// J P = Q [R S]. The columns without a pivot are the freedoms. Lengths are in units of the mechanism's size.
bool Core::find_basis_by_pivoting(double min_pivot) {
  if (qr_configuration_ != configuration_count) {
    qr_.compute(constraints.J() * scales.columns.asDiagonal());
    qr_configuration_ = configuration_count;
  }
  const auto& r = qr_.matrixQR();
  const auto& order = qr_.colsPermutation().indices();
  if (rank && !(std::abs(r(rank - 1, rank - 1)) > min_pivot * std::abs(r(0, 0)))) return false;
  householder_rhs_ = minus_residual_;
  for (int k = 0; k < rank; ++k) {  // apply Q^T
    const auto v = r.col(k).tail(householder_rhs_.size() - k - 1);
    const double projection = qr_.hCoeffs()(k) * (householder_rhs_(k) + v.dot(householder_rhs_.tail(v.size())));
    householder_rhs_(k) -= projection;
    householder_rhs_.tail(v.size()) -= projection * v;
  }
  tangent_.setZero(), x_.setZero();
  for (int i = rank - 1; i >= 0; --i) {  // back substitution: -R^-1 of the right-hand side and of S
    double value = householder_rhs_(i);
    for (int k = i + 1; k < rank; ++k) value -= r(i, k) * x_(order(k));
    x_(order(i)) = value / r(i, i);
    for (int j = 0; j < n - rank; ++j) {
      double entry = -r(i, rank + j);
      for (int k = i + 1; k < rank; ++k) entry -= r(i, k) * tangent_(order(k), j);
      tangent_(order(i), j) = entry / r(i, i);
    }
  }
  for (int j = 0; j < n - rank; ++j) tangent_(basis_coordinates_[j] = order(rank + j), j) = 1.0;
  x_.array() *= scales.columns.array();
  for (int j = 0; j < n - rank; ++j)
    tangent_.col(j).array() *= scales.columns.array() / scales.columns(basis_coordinates_[j]);
  return true;
}

bool Core::find_tangent_basis(In residual, double min_pivot) {
  compute_J();
  minus_residual_ = -residual;  // residual may be residual_ itself
  if (!constraints.closure.rows)
    tangent_.setIdentity(), x_.setZero();
  else if (!find_basis_by_partition()) {
    if (!find_basis_by_pivoting(min_pivot)) return false;
    take_pivots_as_partition();
  }
  return true;
}

void Core::factorize_tangent_inertia() {
  if (inertia_configuration_ == configuration_count && basis_configuration_ == configuration_count) return;
  compute_D_tree();
  restrict_inertia(basis_coordinates_, tangent_, tangent_matrix_);
  tangent_factor_.compute(tangent_matrix_);
  inertia_configuration_ = basis_configuration_;
}

void Core::add_force_response(In force, Out x) {
  tangent_rhs_.noalias() = tangent_.transpose() * force;
  tangent_factor_.solve(tangent_rhs_, tangent_solution_);
  x = x_;
  for (int k = 0; k < n - rank; ++k) x += tangent_solution_(k) * tangent_.col(k);
}

void Core::closure_step_in_z(In residual, Out x) {
  phi_z.solve(residual, z_);
  x.setZero();
  for (size_t k = 0; k < z.size(); ++k) x(z[k]) = -z_(k);
}

void Core::allow_elimination(bool allowed) {
  elimination_allowed_ = allowed;
  if (compiled) compiled->allow_elimination(allowed);
}

bool Core::eliminates() const {
  return (articulated_ || sparse_) && elimination_allowed_ && !compiled && released_.empty() && !uses_mass_levels_;
}

ArticulatedBodies& Core::placed_bodies() {
  if (bodies_configuration_ != configuration_count) articulated_->bodies.set_configuration(tree);
  bodies_configuration_ = configuration_count;
  return articulated_->bodies;
}

bool Core::factorize_without_pivoting() {
  if (!eliminates()) return false;
  if (factors_configuration_ == configuration_count) return elimination_is_accurate_;
  compute_J();
  if (articulated_) {
    placed_bodies();
    elimination_is_accurate_ = articulated_->compute(constraints.J_entries());
  } else {
    compute_D_tree();
    elimination_is_accurate_ = sparse_->compute(D_entries(), constraints.J_entries());
  }
  factors_configuration_ = configuration_count;
  return elimination_is_accurate_;
}

void Core::solve_by_factors(In force, In residual, Out a) {
  if (articulated_)
    articulated_->solve(force, residual, a);
  else
    sparse_->solve(force, residual, a);
}

bool Core::eliminate(In u_tree, In correction, Out acceleration) {
  if (compiled) return compiled_acceleration(q_tree, v_tree, u_tree, correction, acceleration);
  if (!factorize_without_pivoting()) return false;
  compute_bias();
  residual_ = J_dot_v + correction;
  y_ = u_tree - bias_tree + damping_tree;
  solve_by_factors(y_, residual_, acceleration);
  return true;
}

bool Core::elimination_step(In residual, Out x) {
  if (compiled) return compiled->closure_step(q_tree, residual, x);
  if (!factorize_without_pivoting()) return false;
  y_.setZero();
  solve_by_factors(y_, residual, x);
  return true;
}

bool Core::cheapest_closure_step(In residual, Out x) {
  return (compiled && compiled->closure_step(q_tree, residual, x)) || minimum_norm_closure_step(residual, x);
}

bool Core::closure_step(In residual, Out x) {
  if (elimination_step(residual, x)) return true;
  return inertia_metric_step(residual, min_pivot_for_inertia_metric, x) || minimum_norm_closure_step(residual, x);
}

bool Core::inertia_metric_step(In residual, double min_pivot, Out x) {
  if (!find_tangent_basis(residual, min_pivot)) return false;
  factorize_tangent_inertia();
  multiply_D_tree(x_, y_);
  y_ = -y_;
  add_force_response(y_, x);
  return true;
}

bool Core::minimum_norm_closure_step(In residual, Out x) {
  if (!find_tangent_basis(residual, rank_lost_pivot)) return false;
  tangent_matrix_.noalias() = tangent_.transpose() * tangent_;
  tangent_factor_.compute(tangent_matrix_), inertia_configuration_ = -1;
  y_ = -x_;
  add_force_response(y_, x);
  return true;
}

const Matrix* Core::compute_tangent_basis() {
  residual_.setZero();
  return find_tangent_basis(residual_, rank_lost_pivot) ? &tangent_ : nullptr;
}

void Core::particular_solution(In residual, Out x) {
  find_tangent_basis(residual, rank_lost_pivot);
  x = x_;
}

bool Core::dae_acceleration(In u_tree, In correction, Out acceleration) {
  if (eliminate(u_tree, correction, acceleration)) return true;
  compute_bias();
  residual_ = J_dot_v + correction;
  if (!find_tangent_basis(residual_, rank_lost_pivot)) return false;
  if (!uses_mass_levels_ || !project_by_mass_levels(u_tree, acceleration))
    project_on_tangent_space(u_tree, acceleration);
  if (released_.empty()) return true;
  y_ = u_tree - bias_tree + damping_tree;
  return add_released_motion(y_, acceleration);
}

bool Core::unit_row_response(int row, Out x) {
  compute_J();
  residual_.setZero(), residual_(row) = -1.0;
  if (!inertia_metric_step(residual_, rank_lost_pivot, x)) return false;
  if (released_.empty()) return true;
  y_.setZero();
  return add_released_motion(y_, x);
}

bool Core::compute_released_directions() {
  if (released_configuration_ == configuration_count) return true;
  const auto count = static_cast<Eigen::Index>(released_.size());
  const Indices rows = std::exchange(released_, {});  // of all rows here
  released_directions_.resize(n, count), released_rates_.resize(count);
  bool exists = true;
  for (Eigen::Index k = 0; k < count && exists; ++k) exists = unit_row_response(rows[k], released_directions_.col(k));
  released_ = rows;
  if (!exists) return false;
  released_inertia_.resize(count, count);
  for (Eigen::Index k = 0; k < count; ++k) {
    multiply_D_tree(released_directions_.col(k), y_);
    released_inertia_.col(k).noalias() = released_directions_.transpose() * y_;
  }
  released_configuration_ = configuration_count;
  return true;
}

bool Core::add_released_motion(In force, Out a) {
  released_force_ = force;  // may be a workspace
  if (!compute_released_directions()) return false;
  multiply_D_tree(a, y_);
  released_force_ -= y_;
  released_rates_.noalias() = released_directions_.transpose() * released_force_;
  released_rates_ = released_inertia_.llt().solve(released_rates_);
  for (Eigen::Index k = 0; k < released_rates_.size(); ++k) a += released_rates_(k) * released_directions_.col(k);
  return finite(a);
}

void Core::project_on_tangent_space(In u_tree, Out a) {
  factorize_tangent_inertia();
  multiply_D_tree(x_, y_);
  y_ = u_tree - bias_tree - y_ + damping_tree;
  add_force_response(y_, a);
}

bool Core::find_basis_for_check() {
  compute_J(), compute_bias();
  minus_residual_ = -J_dot_v;
  if (n > max_pivoted_size && find_basis_by_partition()) return true;
  basis_configuration_ = -1;  // compute the partition's basis again when it is needed
  if (constraints.closure.rows) return find_basis_by_pivoting(rank_lost_pivot);
  tangent_.setIdentity(), x_.setZero();
  std::iota(basis_coordinates_.begin(), basis_coordinates_.end(), 0);
  return true;
}

// The difference is relative to the acceleration that the forces would cause without cancellation, because near an
// equilibrium the accelerations themselves are rounding errors.
double Core::relative_difference(In a, In reference) {
  const Vector& units = scales.columns;
  double largest = reference.cwiseQuotient(units).lpNorm<Eigen::Infinity>();
  for (int k = 0; k < n - rank; ++k) {
    const auto direction = tangent_.col(k);
    double inertia = 0.0;
    for (int j = 0; j < n; ++j) inertia += direction(j) * direction(j) * D_entries()[tree.D_diagonal[j]];
    const double uncancelled = inertia > 0.0 ? direction.cwiseAbs().dot(y_.cwiseAbs()) / inertia : 0.0;
    largest = std::max(largest, uncancelled * direction.cwiseQuotient(units).lpNorm<Eigen::Infinity>());
  }
  const double difference = (a - reference).cwiseQuotient(units).lpNorm<Eigen::Infinity>();
  if (!std::isfinite(difference)) return std::numeric_limits<double>::infinity();
  return difference > 0.0 ? difference / largest : 0.0;
}

double Core::rounding_of_elimination(In u_tree, double limit) {
  Vector by_elimination(n), reference(n);
  residual_.setZero();
  const bool exists = compiled ? compiled->eliminate(q_tree, v_tree, u_tree, residual_, by_elimination)
                               : eliminate(u_tree, residual_, by_elimination);
  if (!exists || !find_basis_for_check()) return 0.0;
  project_on_tangent_space(u_tree, reference);
  if (!uses_mass_levels_) {
    const double difference = relative_difference(by_elimination, reference);
    if (difference <= limit || !constraints.closure.rows || !find_basis_by_partition()) return difference;
    // Two projections by different bases differ by the rounding of the reference.
    Vector by_partition(n);
    project_on_tangent_space(u_tree, by_partition);
    return std::max(0.0, difference - max_rounding_ratio * relative_difference(by_partition, reference));
  }
  Vector by_levels(n);
  const Vector forces = y_;
  if (project_by_mass_levels(u_tree, by_levels)) reference = by_levels;
  y_ = forces;
  return relative_difference(by_elimination, reference);
}

double Core::rounding_of_projection(In u_tree) {
  Vector by_projection(n), reference(n);
  if (!find_basis_for_check()) return 0.0;
  project_on_tangent_space(u_tree, by_projection);
  const Vector forces = y_;
  if (!project_by_mass_levels(u_tree, reference)) return 0.0;
  y_ = forces;
  return relative_difference(by_projection, reference);
}

bool Core::acceleration_with_held_joints(In force, In correction, Out a) {
  if (!dae_acceleration(force, correction, a)) return false;
  if (joints.locked.empty()) return true;
  if (!unit_force_responses(joints.locked, responses_)) return false;
  acceleration_rounding(joints.locked, responses_, force, a, rounding_);
  joints.add_holding_acceleration(responses_, a);
  return true;
}

// Generalized forces are rounded relative to the largest parts that cancel in them. These are estimated as the force
// that accelerates each joint's own inertia like the fastest coordinate, like gravity, or like the centripetal
// accelerations.
void Core::acceleration_rounding(const Indices& at, const Matrix& columns, In force, In a, Vector& bound) {
  const Vector& reach = joints.table.reach;
  const double fastest_rate = v_tree.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  const double acceleration_scale =
      std::max({a.cwiseQuotient(reach).lpNorm<Eigen::Infinity>(), fastest_rate * fastest_rate,
                tree.spatial_gravity().head<3>().norm() / joints.table.size});
  force_bound_ = force.cwiseAbs();
  for (int k = 0; k < n; ++k) force_bound_(k) += joint_inertia(k) * reach(k) * acceleration_scale;
  bound.noalias() = columns.cwiseAbs().transpose() * force_bound_;
  bound *= acceleration_rounding_factor;
  for (size_t i = 0; i < at.size(); ++i)  // a body at rest still rotates at the rounding of its rate
    bound(static_cast<Eigen::Index>(i)) += reach(at[i]) * joints.rate_rounding * joints.rate_rounding;
  bound *= joints.rounding_factor;
}

bool Core::unit_force_responses(const Indices& at, Matrix& columns) {
  columns.resize(n, static_cast<Eigen::Index>(at.size()));
  residual_.setZero();
  if (factorize_without_pivoting()) {
    if (articulated_)
      articulated_->solve_unit_forces(at, columns);
    else
      sparse_->solve_unit_forces(at, columns);
    return true;
  }
  if (!find_tangent_basis(residual_, rank_lost_pivot)) return false;
  factorize_tangent_inertia();
  for (size_t k = 0; k < at.size(); ++k) {
    y_.setUnit(at[k]);
    add_force_response(y_, columns.col(k));
  }
  for (size_t k = 0; k < at.size() && has_released_rows(); ++k) {
    y_.setUnit(at[k]);
    if (!add_released_motion(y_, columns.col(k))) return false;
  }
  return true;
}

void Core::minimum_norm_multipliers(In force, Out lambda) {
  if (!constraints.closure.rows) return;
  compute_J();
  transposed_.setThreshold(scales.rank);
  transposed_.compute(scales.columns.asDiagonal() * constraints.J().transpose() * scales.rows.asDiagonal());
  lambda = scales.rows.cwiseProduct(transposed_.solve(scales.columns.cwiseProduct(force)));
}

void Core::multipliers(In u_tree, In acceleration, Out lambda) {
  compute_bias(), compute_D_tree();
  multiply_D_tree(acceleration, unbalanced_force_);
  unbalanced_force_ += bias_tree - damping_tree - u_tree;
  lambda.setZero();
  minimum_norm_multipliers(unbalanced_force_, lambda);
}

bool Core::differentiate(In u_tree, In acceleration) {
  multipliers(u_tree, acceleration, lambda_);
  derivatives.compute(q_tree, v_tree, acceleration, lambda_);
  return derivatives.force_by_q.allFinite() && derivatives.row_by_q.allFinite();
}

bool Core::solve_acceleration_derivatives(const Matrix& force, const Matrix& residual, Matrix& derivatives) {
  derivatives.resize(n, force.cols());
  for (Eigen::Index k = 0; k < force.cols(); ++k) {
    residual_ = residual.col(k);
    if (!find_tangent_basis(residual_, rank_lost_pivot)) return false;
    if (!k) factorize_tangent_inertia();
    multiply_D_tree(x_, y_);
    y_ = force.col(k) - y_;
    add_force_response(y_, derivatives.col(k));
  }
  return true;
}

bool Core::acceleration_derivatives(In q_at, In v, In correction, AppliedForce& applied,
                                    AccelerationDerivatives& result, bool with_u) {
  Vector& force = applied.value;
  Matrix &u_by_q = applied.by_q, &u_by_v = applied.by_v;
  Vector& a = result.a;
  Matrix &by_q = result.by_q, &by_v = result.by_v, &by_u = result.by_u;
  joints.add_friction_force(v, force);
  if (joints.has_smooth_friction()) {
    Vector friction_derivative = Vector::Zero(n);
    joints.add_friction_derivative(v, friction_derivative);
    if (!u_by_v.size()) u_by_v.setZero(n, n);
    u_by_v.diagonal() += friction_derivative;
  }
  a.resize(n);
  const bool locked = !joints.locked.empty();
  if (locked) {
    set_velocity(v);
    if (!acceleration_with_held_joints(force, correction, a)) return false;
    for (size_t i = 0; i < joints.locked.size(); ++i)
      force(joints.locked[i]) += joints.holding_forces()(static_cast<Eigen::Index>(i));
  }
  if (compiled && correction.isZero(0) && compiled->evaluate_jacobian(q_at, v, force, by_state_, by_u)) {
    const int nq = tree.nq;
    by_v = by_state_.bottomRightCorner(n, n);
    if (nq == n) {
      by_q = by_state_.bottomLeftCorner(n, n);
    } else {
      by_q.resize(n, n);
      Vector q_rate(nq);
      for (int k = 0; k < n; ++k) {
        tree.configuration_rate(q_at, Vector::Unit(n, k), q_rate);
        by_q.col(k).noalias() = by_state_.bottomLeftCorner(n, nq) * q_rate;
      }
    }
    if (u_by_q.size()) by_q.noalias() += by_u * u_by_q;
    if (u_by_v.size()) by_v.noalias() += by_u * u_by_v;
  } else {
    if (q_tree != q_at) set_configuration(q_at, true);
    set_velocity(v);
    if (!locked && !dae_acceleration(force, correction, a)) return false;
    if (!differentiate(force, a)) return false;
    const DynamicsDerivatives& by = derivatives;
    const auto right_hand_side = [this](const Matrix& u_part, const Matrix& tree_part) -> const Matrix& {
      force_derivative_ = -tree_part;
      if (u_part.size()) force_derivative_ += u_part;
      return force_derivative_;
    };
    if (!solve_acceleration_derivatives(right_hand_side(u_by_q, by.force_by_q), by.row_by_q, by_q) ||
        !solve_acceleration_derivatives(right_hand_side(u_by_v, by.force_by_v), by.row_by_v, by_v))
      return false;
    if (with_u &&
        !solve_acceleration_derivatives(Matrix::Identity(n, n), Matrix::Zero(constraints.closure.rows, n), by_u))
      return false;
  }
  if (locked) {
    Vector locked_correction(n);
    for (Matrix* by : {&by_q, &by_v, with_u ? &by_u : nullptr})
      for (int k = 0; by && k < n; ++k) {
        joints.compute_correction(responses_, by->col(k), locked_correction);
        by->col(k) += locked_correction;
      }
  }
  return finite(by_q.reshaped()) && finite(by_v.reshaped());
}

bool Core::compiled_acceleration(In q_tree, In v, In u_tree, In correction, Out acceleration) const {
  return compiled && released_.empty() && compiled->acceleration(q_tree, v, u_tree, correction, acceleration);
}

}  // namespace ckc
