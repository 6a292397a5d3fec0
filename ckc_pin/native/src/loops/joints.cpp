#include "loops/joints.hpp"

#include <algorithm>
#include <cmath>

#include "loops/box_constrained.hpp"

namespace ckc {

constexpr double hysteresis = 4.0;  // times the rounding error of a decision: what may be wrong until the next one

Joints::Joints(JointTable table_, int n)
    : table(std::move(table_)),
      rubs(table.smoothing == 0.0 && !table.friction.isZero(0)),
      stops(table.lower.array().isFinite().any() || table.upper.array().isFinite().any()),
      sign(n, 0),
      touch(n, 0),
      smooth_(table.smoothing != 0.0 && !table.friction.isZero(0)) {
  place.setZero(n), since_.setZero(n);
}

void Joints::begin() {
  std::fill(sign.begin(), sign.end(), 0), std::fill(touch.begin(), touch.end(), 0);
  locked.clear(), idle.clear(), changes.clear();
  impact_loss = rubbed_ = 0.0;
}

void Joints::add_friction(In v, Out force) const {
  for (Eigen::Index k = 0; k < v.size(); ++k)
    if (smooth_)
      force(k) -= table.friction(k) * std::tanh(v(k) / table.smoothing);
    else if (sign[k])
      force(k) -= table.friction(k) * sign[k];
}

void Joints::add_slopes(In v, Out slopes) const {
  if (!smooth_) return;
  for (Eigen::Index k = 0; k < v.size(); ++k) {
    const double part = std::tanh(v(k) / table.smoothing);
    slopes(k) -= table.friction(k) / table.smoothing * (1.0 - part * part);
  }
}

int Joints::beyond_stop(In q_tree, const Indices& at, double tolerance) const {
  if (!stops) return -1;
  for (size_t k = 0; k < at.size(); ++k) {
    const double x = q_tree(at[k]), off = std::max(table.lower(k) - x, x - table.upper(k));
    if (off > tolerance * table.reach(k) && !is_locked(static_cast<int>(k))) return static_cast<int>(k);
  }
  return -1;
}

void Joints::account(In coordinates) { rubbed_ = dissipated(coordinates) - impact_loss, since_ = coordinates; }

void Joints::lock(Indices which, In coordinates) {
  locked = std::move(which);
  for (int k : locked) place(k) = touch[k] ? stop_at(k, touch[k]) : coordinates(k);
}

double Joints::dissipated(In coordinates) const {
  double work = rubbed_ + impact_loss;
  for (size_t k = 0; k < sign.size(); ++k)
    if (sign[k]) work += table.friction(k) * sign[k] * (coordinates(k) - since_(k));
  return work;
}

void Joints::factor(const Matrix& responses) {
  const auto m = static_cast<Eigen::Index>(locked.size());
  A_.resize(m, m), scale_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) scale_(i) = 1.0 / std::sqrt(std::max(responses(locked[i], i), 1e-300));
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j)
      A_(i, j) = 0.5 * scale_(i) * scale_(j) * (responses(locked[i], j) + responses(locked[j], i));
  eigen_.compute(A_);
  const auto& values = eigen_.eigenvalues();
  for (rank_ = 0; rank_ < m && values(m - 1 - rank_) > dependent * values(m - 1);) ++rank_;
}

// The least forces, each measured in what it takes to move its own joint, that make the rows x.
void Joints::least_forces(const Matrix& responses, In x, Vector& force) {
  factor(responses);
  const auto m = static_cast<Eigen::Index>(locked.size());
  wanted_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) wanted_(i) = -scale_(i) * x(locked[i]);
  const auto vectors = eigen_.eigenvectors().rightCols(rank_);
  const Vector along = (vectors.transpose() * wanted_).cwiseQuotient(eigen_.eigenvalues().tail(rank_));
  force.noalias() = vectors * along;
  for (Eigen::Index i = 0; i < m; ++i) force(i) *= scale_(i);
}

void Joints::back(const Matrix& responses, In x, Out step) {
  least_forces(responses, x, back_);
  step.noalias() = responses.leftCols(back_.size()) * back_;
}

void Joints::hold(const Matrix& responses, Out a) {
  least_forces(responses, a, force_);
  a.noalias() += responses.leftCols(force_.size()) * force_;
  for (int k : locked) a(k) = 0.0;  // what is left is rounding
}

Matrix Joints::inverse_root() const {
  return eigen_.eigenvalues().tail(rank_).cwiseSqrt().cwiseInverse().asDiagonal() *
         eigen_.eigenvectors().rightCols(rank_).transpose();
}

Vector Joints::force_rounding(const Matrix& inverse_root, In rounding) const {
  const Matrix inverse = inverse_root.transpose() * inverse_root;
  return hysteresis * (inverse.cwiseAbs() * scale_.cwiseProduct(rounding));
}

// Joints that are held in several ways have forces that may be others, and are left out.
Indices Joints::at_limit(In rounding) const {
  Indices at;
  if (rank_ < A_.rows()) return at;
  const Vector bound = force_rounding(inverse_root(), rounding);
  for (Eigen::Index i = 0; i < A_.rows(); ++i) {
    const int k = locked[i];
    if (std::min(force_(i) - lower_force(k), upper_force(k) - force_(i)) <= bound(i) * scale_(i))
      at.push_back(static_cast<int>(i));
  }
  return at;
}

// By how much the forces stay within their bounds, at best: where the joints are held in more than one way, forces that
// cancel each other may be added. Bounds are widened by what rounding may make of the forces.
double Joints::margin(In rounding) {
  const Eigen::Index m = A_.rows();
  const Matrix inverse_root = this->inverse_root();
  const Vector scaled = force_rounding(inverse_root, rounding);
  Vector force(m), low(m), high(m);  // each measured in what it takes to move its own joint
  for (Eigen::Index i = 0; i < m; ++i) {
    force(i) = force_(i) / scale_(i);
    low(i) = lower_force(locked[i]) / scale_(i) - scaled(i);
    high(i) = upper_force(locked[i]) / scale_(i) + scaled(i);
  }
  double least = infinite;
  if (rank_ == m) {
    for (Eigen::Index i = 0; i < m; ++i)
      least = std::min(least, std::min(force(i) - low(i), high(i) - force(i)) / inverse_root.col(i).norm());
    return least;
  }
  least = largest_slack(eigen_.eigenvectors().leftCols(m - rank_), force, low, high);
  return std::isfinite(least) ? least : 1.0;
}

}  // namespace ckc
