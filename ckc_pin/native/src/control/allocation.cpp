#include "control/allocation.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double u_rounding = 1e-13;           // accepted relative error of the scaled u
constexpr double curvature_tolerance = 1e-12;  // the dual is flat below it, relative to its largest curvature
constexpr double penalty = 1e-7;               // weight of a deviation from u, relative to the largest curvature
constexpr double full_step_tolerance = 1e-6;   // a Newton step whose length differs from 1 by less is a full step
constexpr int max_newton_steps = 50;           // random problems need at most 10

Allocation::Allocation(int motors, int d, Vector lower_, Vector upper_, Vector weights, Vector preload)
    : lower(std::move(lower_)),
      upper(std::move(upper_)),
      weights_(std::move(weights)),
      preload_(std::move(preload)),
      scale_(weights_.cwiseSqrt().cwiseInverse()),
      redundant_(motors != d),
      eigen_(d) {
  if (redundant_)
    factor_.set_pattern(motors, d, std::vector<Indices>(motors));
  else
    factor_.set_pattern(motors, motors, full_pattern(motors));
  scaled_.setZero(redundant_ ? motors : d, redundant_ ? d : motors), curvature_.setZero(d, d);
  for (Vector* x : {&residual_, &row_scale_, &multiplier_, &direction_, &coefficients_}) x->setZero(d);
  for (Vector* x : {&unlimited_, &unclamped_, &tau_direction_, &becomes_free_, &becomes_limited_}) x->setZero(motors);
  breakpoints_.setZero(2 * motors);
  // A solver that has computed nothing cannot be moved, so use it once.
  eigen_.compute(Matrix::Identity(std::max(d, 1), std::max(d, 1)));
}

void Allocation::allocate(const Matrix& transmission, In u, Out tau) {
  if (redundant_) {
    scaled_ = transmission, scaled_.array().colwise() *= scale_.array();
    residual_ = u, residual_.noalias() -= transmission.transpose() * preload_;
    factor_.compute(scaled_), factor_.solve_transposed(residual_, tau);
    tau = preload_ + scale_.cwiseProduct(tau);
  } else {
    scaled_ = transmission.transpose();
    factor_.compute(scaled_), factor_.solve(u, tau);
  }
  if (!(tau.array() > upper.array() || tau.array() < lower.array()).any()) return;
  unlimited_ = tau;
  if (redundant_ && (solve_with_limits(transmission, u, tau, 0.0) || solve_with_limits(transmission, u, tau, penalty)))
    return;
  tau = unlimited_, clamp(tau);
}

// Solve by Newton's method on the dual. With a `penalty_weight` (relative to the largest curvature), deviations from u
// have a quadratic cost. False if that fails or u is out of reach.
bool Allocation::solve_with_limits(const Matrix& transmission, In u, Out tau, double penalty_weight) {
  const auto m = transmission.rows();
  for (Eigen::Index i = 0; i < row_scale_.size(); ++i)
    row_scale_(i) = 1.0 / std::max(transmission.col(i).norm(), 1e-300);
  scaled_ = transmission, scaled_.array().rowwise() *= row_scale_.array().transpose();
  coefficients_ = u.cwiseProduct(row_scale_);
  double size = coefficients_.norm(), steepest = 0.0;
  for (Eigen::Index k = 0; k < m; ++k) {
    double largest = 0.0;
    for (const double limit : {lower(k), upper(k)})
      if (std::isfinite(limit)) largest = std::max(largest, std::abs(limit));
    size += largest * scaled_.row(k).norm();
    steepest += scaled_.row(k).squaredNorm() / weights_(k);
  }
  multiplier_.setZero(), free_.assign(m, 0), penalty_weight *= steepest;
  bool took_full_step = false;
  for (int step = 0; step < max_newton_steps; ++step) {
    unclamped_.noalias() = scaled_ * multiplier_;
    if (step && penalty_weight == 0.0 && is_out_of_reach(u, u_rounding * size)) return false;
    unclamped_ = preload_ + unclamped_.cwiseQuotient(weights_);
    tau = unclamped_, clamp(tau);
    residual_ = u.cwiseProduct(row_scale_) - penalty_weight * multiplier_,
    residual_.noalias() -= scaled_.transpose() * tau;
    const bool solved = residual_.norm() <= u_rounding * size;
    bool active_set_unchanged = took_full_step;
    curvature_.setZero();
    for (Eigen::Index k = 0; k < m; ++k) {
      const int is_free = lower(k) < unclamped_(k) && unclamped_(k) < upper(k);
      active_set_unchanged &= free_[k] == is_free, free_[k] = is_free;
      if (is_free) curvature_.noalias() += (1.0 / weights_(k)) * scaled_.row(k).transpose() * scaled_.row(k);
    }
    if (solved || active_set_unchanged) return true;
    eigen_.compute(curvature_);
    coefficients_.noalias() = eigen_.eigenvectors().transpose() * residual_;
    const Vector& values = eigen_.eigenvalues();
    double flat_norm_squared = 0.0;  // squared norm of the residual along flat directions
    for (Eigen::Index i = 0; i < values.size(); ++i)
      if (values(i) <= curvature_tolerance * steepest) flat_norm_squared += coefficients_(i) * coefficients_(i);
    const bool follows_flat_direction = std::sqrt(flat_norm_squared) > u_rounding * size;
    for (Eigen::Index i = 0; i < values.size(); ++i) {
      const bool curved = values(i) > curvature_tolerance * steepest;
      if (penalty_weight > 0.0)
        coefficients_(i) /= values(i) + penalty_weight;
      else if (follows_flat_direction)
        coefficients_(i) = curved ? 0.0 : coefficients_(i);
      else
        coefficients_(i) = curved ? coefficients_(i) / values(i) : 0.0;
    }
    direction_.noalias() = eigen_.eigenvectors() * coefficients_;
    directional_derivative_ = direction_.dot(residual_);
    tau_direction_.noalias() = scaled_ * direction_;
    tau_direction_ = tau_direction_.cwiseQuotient(weights_);
    const double length = line_search(penalty_weight * direction_.squaredNorm());
    if (!std::isfinite(length)) return false;
    multiplier_ += length * direction_;
    took_full_step = penalty_weight > 0.0 && std::abs(length - 1.0) < full_step_tolerance;
  }
  return false;
}

// Whether the multiplier proves that u is out of reach of all motors together (Farkas' lemma).
bool Allocation::is_out_of_reach(In u, double tolerance) const {
  const double length = multiplier_.norm();
  double bound = tolerance * length;
  for (Eigen::Index k = 0; k < unclamped_.size(); ++k) {
    const double pull = unclamped_(k), limit = pull > 0.0 ? upper(k) : lower(k);
    if (std::isfinite(limit))
      bound += limit * pull;
    else if (std::abs(pull) > u_rounding * length * scaled_.row(k).norm())
      return false;
  }
  return multiplier_.dot(u.cwiseProduct(row_scale_)) > bound;
}

// Maximize the dual along direction_. Its derivative starts at directional_derivative_ and decreases by weight
// tau_direction^2 for each motor within its limits, and by `penalty_curvature`.
double Allocation::line_search(double penalty_curvature) {
  const auto m = tau_direction_.size();
  Eigen::Index count = 0;
  for (Eigen::Index k = 0; k < m; ++k) {
    becomes_free_(k) = 0.0, becomes_limited_(k) = tau_direction_(k) == 0.0 ? 0.0 : infinity;
    if (tau_direction_(k) == 0.0 || !is_limited(k)) continue;
    const double low = (lower(k) - unclamped_(k)) / tau_direction_(k),
                 high = (upper(k) - unclamped_(k)) / tau_direction_(k);
    becomes_free_(k) = std::max(0.0, std::min(low, high)), becomes_limited_(k) = std::max(0.0, std::max(low, high));
    breakpoints_(count++) = becomes_free_(k), breakpoints_(count++) = becomes_limited_(k);
  }
  std::sort(breakpoints_.data(), breakpoints_.data() + count);
  double at = 0.0, derivative = directional_derivative_;
  for (Eigen::Index i = 0; i <= count; ++i) {
    const double end = i < count ? breakpoints_(i) : infinity;
    if (!(end > at)) continue;
    double curvature = penalty_curvature;
    for (Eigen::Index k = 0; k < m; ++k)
      if (becomes_free_(k) <= at && becomes_limited_(k) > at)
        curvature += weights_(k) * tau_direction_(k) * tau_direction_(k);
    if (curvature > 0.0 && derivative <= curvature * (end - at)) return at + derivative / curvature;
    if (curvature > 0.0) derivative -= curvature * (end - at);
    at = end;
  }
  return infinity;
}

}  // namespace ckc
