#include "loops/joints.hpp"

#include <algorithm>
#include <cmath>

#include "loops/box_constrained.hpp"

namespace ckc {

// A locked joint stays locked while its force violates the bound by less than this times the rounding error of the
// decision to lock it.
constexpr double rounding_hysteresis = 4.0;

Joints::Joints(JointTable table_, int n)
    : table(std::move(table_)),
      has_friction_events(table.smoothing == 0.0 && !table.friction.isZero(0)),
      has_stops(table.lower.array().isFinite().any() || table.upper.array().isFinite().any()),
      sliding_direction(n, 0),
      stop_side(n, 0),
      smooth_friction_(table.smoothing != 0.0 && !table.friction.isZero(0)) {
  locked_at.setZero(n), accounted_at_.setZero(n);
}

void Joints::reset() {
  std::fill(sliding_direction.begin(), sliding_direction.end(), 0), std::fill(stop_side.begin(), stop_side.end(), 0);
  locked.clear(), immobile.clear(), transitions.clear();
  impact_loss = friction_work_ = 0.0;
}

void Joints::add_friction_force(In v, Out force) const {
  for (Eigen::Index k = 0; k < v.size(); ++k)
    if (smooth_friction_)
      force(k) -= table.friction(k) * std::tanh(v(k) / table.smoothing);
    else if (sliding_direction[k])
      force(k) -= table.friction(k) * sliding_direction[k];
}

void Joints::add_friction_derivative(In v, Out slopes) const {
  if (!smooth_friction_) return;
  for (Eigen::Index k = 0; k < v.size(); ++k) {
    const double saturation = std::tanh(v(k) / table.smoothing);
    slopes(k) -= table.friction(k) / table.smoothing * (1.0 - saturation * saturation);
  }
}

int Joints::find_joint_beyond_stop(In q_tree, const Indices& at, double tolerance) const {
  if (!has_stops) return -1;
  for (size_t k = 0; k < at.size(); ++k) {
    const double x = q_tree(at[k]), distance = std::max(table.lower(k) - x, x - table.upper(k));
    if (distance > tolerance * table.reach(k) && !is_locked(static_cast<int>(k))) return static_cast<int>(k);
  }
  return -1;
}

void Joints::account_friction_work(In coordinates) {
  friction_work_ = dissipated_energy(coordinates) - impact_loss, accounted_at_ = coordinates;
}

void Joints::lock(Indices which, In coordinates) {
  locked = std::move(which);
  for (int k : locked) locked_at(k) = stop_side[k] ? stop_at(k, stop_side[k]) : coordinates(k);
}

double Joints::dissipated_energy(In coordinates) const {
  double work = friction_work_ + impact_loss;
  for (size_t k = 0; k < sliding_direction.size(); ++k)
    if (sliding_direction[k]) work += table.friction(k) * sliding_direction[k] * (coordinates(k) - accounted_at_(k));
  return work;
}

void Joints::factorize_locked_rows(const Matrix& responses) {
  const auto m = static_cast<Eigen::Index>(locked.size());
  A_.resize(m, m), scale_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) scale_(i) = 1.0 / std::sqrt(std::max(responses(locked[i], i), 1e-300));
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j)
      A_(i, j) = 0.5 * scale_(i) * scale_(j) * (responses(locked[i], j) + responses(locked[j], i));
  eigen_.compute(A_);
  const auto& values = eigen_.eigenvalues();
  for (rank_ = 0; rank_ < m && values(m - 1 - rank_) > dependent_row_tolerance * values(m - 1);) ++rank_;
}

// Minimum-norm forces that cancel the acceleration x of the locked coordinates. Each force is scaled by the response
// of its own joint.
void Joints::minimum_norm_forces(const Matrix& responses, In x, Vector& force) {
  factorize_locked_rows(responses);
  const auto m = static_cast<Eigen::Index>(locked.size());
  target_acceleration_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) target_acceleration_(i) = -scale_(i) * x(locked[i]);
  const auto vectors = eigen_.eigenvectors().rightCols(rank_);
  const Vector components =
      (vectors.transpose() * target_acceleration_).cwiseQuotient(eigen_.eigenvalues().tail(rank_));
  force.noalias() = vectors * components;
  for (Eigen::Index i = 0; i < m; ++i) force(i) *= scale_(i);
}

void Joints::compute_correction(const Matrix& responses, In x, Out step) {
  minimum_norm_forces(responses, x, correction_forces_);
  step.noalias() = responses.leftCols(correction_forces_.size()) * correction_forces_;
}

void Joints::add_holding_acceleration(const Matrix& responses, Out a) {
  minimum_norm_forces(responses, a, holding_forces_);
  a.noalias() += responses.leftCols(holding_forces_.size()) * holding_forces_;
  for (int k : locked) a(k) = 0.0;  // the remainder is rounding
}

Matrix Joints::inverse_root() const {
  return eigen_.eigenvalues().tail(rank_).cwiseSqrt().cwiseInverse().asDiagonal() *
         eigen_.eigenvectors().rightCols(rank_).transpose();
}

Vector Joints::force_rounding(const Matrix& inverse_root, In rounding) const {
  const Matrix inverse = inverse_root.transpose() * inverse_root;
  return rounding_hysteresis * (inverse.cwiseAbs() * scale_.cwiseProduct(rounding));
}

// If the holding forces are not unique, no joint is returned.
Indices Joints::find_joints_at_force_limit(In rounding) const {
  Indices at;
  if (rank_ < A_.rows()) return at;
  const Vector bound = force_rounding(inverse_root(), rounding);
  for (Eigen::Index i = 0; i < A_.rows(); ++i) {
    const int k = locked[i];
    if (std::min(holding_forces_(i) - lower_force(k), upper_force(k) - holding_forces_(i)) <= bound(i) * scale_(i))
      at.push_back(static_cast<int>(i));
  }
  return at;
}

// Largest distance of the forces from their bounds, which are widened by rounding. If the forces are not unique, those
// that maximize the distance are chosen.
double Joints::holding_margin(In rounding) {
  const Eigen::Index m = A_.rows();
  const Matrix inverse_root = this->inverse_root();
  const Vector rounding_bound = force_rounding(inverse_root, rounding);
  Vector force(m), low(m), high(m);  // each force scaled by the response of its own joint
  for (Eigen::Index i = 0; i < m; ++i) {
    force(i) = holding_forces_(i) / scale_(i);
    low(i) = lower_force(locked[i]) / scale_(i) - rounding_bound(i);
    high(i) = upper_force(locked[i]) / scale_(i) + rounding_bound(i);
  }
  double margin = infinite;
  if (rank_ == m) {
    for (Eigen::Index i = 0; i < m; ++i)
      margin = std::min(margin, std::min(force(i) - low(i), high(i) - force(i)) / inverse_root.col(i).norm());
    return margin;
  }
  margin = maximize_bound_distance(eigen_.eigenvectors().leftCols(m - rank_), force, low, high);
  return std::isfinite(margin) ? margin : 1.0;
}

}  // namespace ckc
