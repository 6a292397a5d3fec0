#include "control/allocation.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double rounding = 1e-13;  // of u, scaled: what a tau may miss it by
constexpr double flat = 1e-12;      // of the dual's largest curvature: a direction in which it has none
constexpr double gives = 1e-7;      // of that curvature: added where u is out of reach
constexpr double settled = 1e-6;    // how far from 1 the length of Newton's last step is
constexpr int most = 50;            // steps; random problems take at most 10

Allocation::Allocation(int motors, int d, Vector limit_, Vector weights, Vector preload)
    : limit(std::move(limit_)),
      weights_(std::move(weights)),
      preload_(std::move(preload)),
      scale_(weights_.cwiseSqrt().cwiseInverse()),
      redundant_(motors != d),
      eigen_(d) {
  if (redundant_)
    factor_.shape(motors, d, std::vector<Indices>(motors));
  else
    factor_.shape(motors, motors, full_pattern(motors));
  scaled_.setZero(redundant_ ? motors : d, redundant_ ? d : motors), curvature_.setZero(d, d);
  for (Vector* x : {&rest_, &row_scale_, &multiplier_, &direction_, &coefficients_}) x->setZero(d);
  for (Vector* x : {&unlimited_, &raw_, &slope_, &enters_, &leaves_}) x->setZero(motors);
  ends_.setZero(2 * motors);
  if (d) eigen_.compute(Matrix::Identity(d, d));  // what has computed nothing has no state that may be moved
}

void Allocation::share(const Matrix& transmission, In u, Out tau) {
  if (redundant_) {
    scaled_ = transmission, scaled_.array().colwise() *= scale_.array();
    rest_ = u, rest_.noalias() -= transmission.transpose() * preload_;
    factor_.compute(scaled_), factor_.solve_transposed(rest_, tau);
    tau = preload_ + scale_.cwiseProduct(tau);
  } else {
    scaled_ = transmission.transpose();
    factor_.compute(scaled_), factor_.solve(u, tau);
  }
  if (!(tau.array().abs() > limit.array()).any()) return;
  unlimited_ = tau;
  if (redundant_ && (within_limits(transmission, u, tau, 0.0) || within_limits(transmission, u, tau, gives))) return;
  tau = unlimited_, clip(tau);
}

// With `give`, of the largest curvature, u may be missed, at a price of the miss squared by `give`.
bool Allocation::within_limits(const Matrix& transmission, In u, Out tau, double give) {
  const auto m = transmission.rows();
  for (Eigen::Index i = 0; i < row_scale_.size(); ++i) row_scale_(i) = 1.0 / std::max(transmission.col(i).norm(), 1e-300);
  scaled_ = transmission, scaled_.array().rowwise() *= row_scale_.array().transpose();
  coefficients_ = u.cwiseProduct(row_scale_);
  double size = coefficients_.norm(), steepest = 0.0;
  for (Eigen::Index k = 0; k < m; ++k) {
    if (std::isfinite(limit(k))) size += limit(k) * scaled_.row(k).norm();
    steepest += scaled_.row(k).squaredNorm() / weights_(k);
  }
  multiplier_.setZero(), free_.assign(m, 0), give *= steepest;
  bool whole = false;
  for (int step = 0; step < most; ++step) {
    raw_.noalias() = scaled_ * multiplier_;
    if (step && give == 0.0 && beyond(u, rounding * size)) return false;
    raw_ = preload_ + raw_.cwiseQuotient(weights_);
    tau = raw_, clip(tau);
    rest_ = u.cwiseProduct(row_scale_) - give * multiplier_, rest_.noalias() -= scaled_.transpose() * tau;
    const bool solved = rest_.norm() <= rounding * size;
    bool same = whole;
    curvature_.setZero();
    for (Eigen::Index k = 0; k < m; ++k) {
      const int is_free = std::abs(raw_(k)) < limit(k);
      same &= free_[k] == is_free, free_[k] = is_free;
      if (is_free) curvature_.noalias() += (1.0 / weights_(k)) * scaled_.row(k).transpose() * scaled_.row(k);
    }
    if (solved || same) return true;
    eigen_.compute(curvature_);
    coefficients_.noalias() = eigen_.eigenvectors().transpose() * rest_;
    const Vector& values = eigen_.eigenvalues();
    double level = 0.0;  // along what has no curvature
    for (Eigen::Index i = 0; i < values.size(); ++i)
      if (values(i) <= flat * steepest) level += coefficients_(i) * coefficients_(i);
    const bool straight = std::sqrt(level) > rounding * size;
    for (Eigen::Index i = 0; i < values.size(); ++i) {
      const bool curved = values(i) > flat * steepest;
      if (give > 0.0)
        coefficients_(i) /= values(i) + give;
      else if (straight)
        coefficients_(i) = curved ? 0.0 : coefficients_(i);
      else
        coefficients_(i) = curved ? coefficients_(i) / values(i) : 0.0;
    }
    direction_.noalias() = eigen_.eigenvectors() * coefficients_;
    rise_ = direction_.dot(rest_);
    slope_.noalias() = scaled_ * direction_;
    slope_ = slope_.cwiseQuotient(weights_);
    const double length = along(give * direction_.squaredNorm());
    if (!std::isfinite(length)) return false;
    multiplier_ += length * direction_;
    whole = give > 0.0 && std::abs(length - 1.0) < settled;
  }
  return false;
}

// Whether what the multiplier weighs in u is more than all motors together can do (Farkas).
bool Allocation::beyond(In u, double least) const {
  const double length = multiplier_.norm();
  double most = least * length;
  for (Eigen::Index k = 0; k < raw_.size(); ++k) {
    const double pull = std::abs(raw_(k));
    if (std::isfinite(limit(k)))
      most += limit(k) * pull;
    else if (pull > rounding * length * scaled_.row(k).norm())
      return false;
  }
  return multiplier_.dot(u.cwiseProduct(row_scale_)) > most;
}

// Along direction_ the dual's slope falls from rise_ by w slope^2 for every motor while it is within its limits, and `bent`.
double Allocation::along(double bent) {
  const auto m = slope_.size();
  Eigen::Index count = 0;
  for (Eigen::Index k = 0; k < m; ++k) {
    enters_(k) = 0.0, leaves_(k) = slope_(k) == 0.0 ? 0.0 : infinity;
    if (slope_(k) == 0.0 || !std::isfinite(limit(k))) continue;
    const double low = (-limit(k) - raw_(k)) / slope_(k), high = (limit(k) - raw_(k)) / slope_(k);
    enters_(k) = std::max(0.0, std::min(low, high)), leaves_(k) = std::max(0.0, std::max(low, high));
    ends_(count++) = enters_(k), ends_(count++) = leaves_(k);
  }
  std::sort(ends_.data(), ends_.data() + count);
  double at = 0.0, left = rise_;
  for (Eigen::Index i = 0; i <= count; ++i) {
    const double end = i < count ? ends_(i) : infinity;
    if (!(end > at)) continue;
    double bend = bent;
    for (Eigen::Index k = 0; k < m; ++k)
      if (enters_(k) <= at && leaves_(k) > at) bend += weights_(k) * slope_(k) * slope_(k);
    if (bend > 0.0 && left <= bend * (end - at)) return at + left / bend;
    if (bend > 0.0) left -= bend * (end - at);
    at = end;
  }
  return infinity;
}

}  // namespace ckc
