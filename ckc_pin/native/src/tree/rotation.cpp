#include "tree/rotation.hpp"

namespace ckc {

namespace {

constexpr double max_series_squared_angle = 1.0;  // rad^2; the series converges up to |u|^2 = (2 pi)^2
// Coefficients of c = (1 - x/2 cot(x/2)) / x^2 in powers of x^2: |B_2k| / (2k)!.
constexpr double series[] = {1.0 / 12,
                             1.0 / 720,
                             1.0 / 30240,
                             1.0 / 1209600,
                             1.0 / 47900160,
                             691.0 / 1307674368000.0,
                             1.0 / 74724249600.0,
                             3617.0 / 10670622842880000.0,
                             43867.0 / 5109094217170944000.0,
                             174611.0 / 802857662698291200000.0,
                             77683.0 / 14101100039391805440000.0};
constexpr int series_terms = sizeof(series) / sizeof(double);

}  // namespace

LogJacobian::LogJacobian(const Vector3& u) : u_(u), s_(skew(u)) {
  const double s = u.squaredNorm();
  if (s < max_series_squared_angle) {
    c_ = c_rate_ = c_second_ = 0.0;
    for (int k = series_terms - 1; k >= 0; --k) c_ = c_ * s + series[k];
    for (int k = series_terms - 1; k >= 1; --k) c_rate_ = c_rate_ * s + 2 * k * series[k];
    for (int k = series_terms - 1; k >= 2; --k) c_second_ = c_second_ * s + 4 * k * (k - 1) * series[k];
  } else {
    const double x = std::sqrt(s), cotangent = 1 / std::tan(x / 2), sine = std::sin(x / 2), square = 1 / (sine * sine);
    c_ = 1 / s - cotangent / (2 * x);
    c_rate_ = (-2 / (s * x) + cotangent / (2 * s) + square / (4 * x)) / x;
    c_second_ = (8 / (s * s) - 3 * cotangent / (2 * s * x) - 3 * square / (4 * s) - cotangent * square / (4 * x)) / s;
  }
  value = Matrix3::Identity() + s_ / 2 + c_ * s_ * s_;
}

Matrix3 LogJacobian::derivative(const Vector3& a) const {
  const Matrix3 s_a = skew(a);
  return s_a / 2 + c_rate_ * u_.dot(a) * s_ * s_ + c_ * (s_a * s_ + s_ * s_a);
}

Matrix3 LogJacobian::second_derivative(const Vector3& a, const Vector3& b) const {
  const Matrix3 s_a = skew(a), s_b = skew(b);
  const double ua = u_.dot(a), ub = u_.dot(b);
  return (c_second_ * ua * ub + c_rate_ * a.dot(b)) * s_ * s_ + c_rate_ * ua * (s_b * s_ + s_ * s_b) +
         c_rate_ * ub * (s_a * s_ + s_ * s_a) + c_ * (s_a * s_b + s_b * s_a);
}

}  // namespace ckc
