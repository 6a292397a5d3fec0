// Sign changes of a function within a step.
#include "motion/events.hpp"

#include <algorithm>
#include <cmath>

#include <boost/math/tools/minima.hpp>
#include <boost/math/tools/toms748_solve.hpp>

namespace ckc {

constexpr double zero_rounding = 1e-12;        // smaller values are zero; relative to the largest value in the step
constexpr double max_extremum_ratio = 0.25;    // extrema closer to zero are refined; relative to the range in the step
constexpr double root_time_tolerance = 1e-12;  // s
constexpr int max_secant_steps = 6;            // from a root of the cheap function to that of the exact one
constexpr double secant_width = 1e-3;          // of the first secant, relative to the step; also its relative error
constexpr int fine_points_per_degree = 64;     // at which extrema of the interpolating polynomial are searched
constexpr int kink_search_bits = 30;           // bits of accuracy of the search for a kink
// Extrema of the cheap function closer to zero than this times its error may touch zero.
constexpr double max_exact_difference_ratio = 10.0;

namespace {

// Maps values at the sample points to values of their interpolating polynomial at fine points.
struct Chebyshev {
  Matrix to_fine;
  Vector fine_points;
  Chebyshev() {
    const int n = sample_degree;
    const auto polynomials = [](const Vector& x) {
      Matrix values(x.size(), sample_degree + 1);
      for (Eigen::Index i = 0; i < x.size(); ++i)
        for (int k = 0; k <= sample_degree; ++k) values(i, k) = std::cos(k * std::acos(std::clamp(x(i), -1.0, 1.0)));
      return values;
    };
    const Vector x = 2 * sample_points().array() - 1;
    fine_points = Vector::LinSpaced(n * fine_points_per_degree + 1, 0.0, 1.0);
    to_fine = polynomials(2 * fine_points.array() - 1) * polynomials(x).inverse();
  }
};

const Chebyshev& chebyshev() {
  static const Chebyshev once;
  return once;
}

void insert_point(Points& points, double t, double value) {
  const auto at =
      std::lower_bound(points.begin(), points.end(), t, [](const auto& p, double t) { return p.first < t; });
  if (at == points.end() || at->first != t) points.insert(at, {t, value});
}

bool find_root(const ScalarFunction& function, const std::pair<double, double>& start,
               const std::pair<double, double>& end, double& t) {
  t = start.first;
  if (start.second * end.second >= 0) return true;  // zero at the start of the step, or within the threshold
  bool exists = true;
  const auto evaluate = [&](double at) {
    double value = start.second;
    exists = exists && function(at, value);
    return value;
  };
  const auto is_close = [](double a, double b) {
    return std::abs(b - a) <= root_time_tolerance + 4 * std::numeric_limits<double>::epsilon() * std::abs(a);
  };
  std::uintmax_t max_iterations = 200;
  const auto [a, b] = boost::math::tools::toms748_solve(evaluate, start.first, end.first, start.second, end.second,
                                                        is_close, max_iterations);
  t = 0.5 * (a + b);
  return exists;
}

// Improve a root of the approximate function to a root of the exact one.
bool refine_root(const ScalarFunction& function, const ScalarFunction& exact, const std::pair<double, double>& start,
                 const std::pair<double, double>& end, double& t) {
  const double width = secant_width * (end.first - start.first), initial_t = t;
  const double lower = std::max(t - width, start.first), upper = std::min(t + width, end.first);
  double value_below, value_above;
  if (!function(lower, value_below) || !function(upper, value_above)) return false;
  double slope = (value_above - value_below) / (upper - lower), at = t, previous_t = t, value_before = 0.0, value;
  for (int k = 0; k < max_secant_steps && slope * end.second > 0.0; ++k) {
    if (!exact(at, value)) return false;
    if (k && value != value_before) slope = (value - value_before) / (at - previous_t);
    const double step = value / slope,
                 accuracy = root_time_tolerance + 4 * std::numeric_limits<double>::epsilon() * std::abs(at);
    previous_t = at, value_before = value;
    at = std::clamp(at - step, start.first, end.first);
    if (!(std::abs(step) * (k ? 1.0 : secant_width) > accuracy)) return t = at, true;
  }
  double first, last;
  if (!exact(start.first, first) || !exact(end.first, last)) return false;
  t = initial_t;
  return first * last < 0.0 ? find_root(exact, {start.first, first}, {end.first, last}, t) : true;
}

// Find out whether the exact function may touch zero where the approximate one does not, or vice versa. False if the
// function has no value.
bool may_touch_zero(const ScalarFunction& exact, double range, const Points& points, bool& may_touch) {
  may_touch = false;
  for (size_t k = 1; k + 1 < points.size() && !may_touch; ++k) {
    const auto& [t, value] = points[k];
    const bool extreme = (value - points[k - 1].second) * (value - points[k + 1].second) >= 0.0;
    if (!extreme || !(std::abs(value) < max_extremum_ratio * range)) continue;
    double exact_value;
    if (!exact(t, exact_value)) return false;
    may_touch = std::abs(value) <= max_exact_difference_ratio * std::abs(exact_value - value);
  }
  return true;
}

}  // namespace

const Vector& sample_points() {
  static const Vector once = Vector::NullaryExpr(
      sample_degree + 1, [](Eigen::Index k) { return (1.0 - std::cos(M_PI * k / sample_degree)) / 2; });
  return once;
}

// Add points between the samples where the function is closest to zero.
bool RootSearch::add_extrema(const ScalarFunction& function, Interval step, In values, double zero) {
  const double range = values.maxCoeff() - values.minCoeff();
  if (!(values.cwiseAbs().minCoeff() <= range)) return true;  // too far from zero to reach it and return
  fine_values_.noalias() = chebyshev().to_fine * values;
  for (Eigen::Index i = 1; i + 1 < fine_values_.size(); ++i) {
    const double slope_before = fine_values_(i) - fine_values_(i - 1),
                 slope_after = fine_values_(i + 1) - fine_values_(i);
    if (!(slope_before * slope_after < 0.0)) continue;
    const double spacing = chebyshev().fine_points(1),
                 shift = 0.5 * (slope_before + slope_after) / (slope_before - slope_after);
    const double t = step.at(chebyshev().fine_points(i) + shift * spacing);
    double value;
    if (!function(t, value)) return false;
    insert_point(points_, t, value);
  }
  kinks_.clear();
  for (size_t k = 0; k < points_.size(); ++k) {
    const auto& [t, value] = points_[k];
    const auto &lower = points_[k ? k - 1 : 0], &upper = points_[std::min(k + 1, points_.size() - 1)];
    const bool nearest = value * lower.second > 0 && value * upper.second > 0 &&
                         std::abs(value) <= std::abs(lower.second) && std::abs(value) <= std::abs(upper.second);
    if (!nearest || !(std::abs(value) > zero) || !(std::abs(value) < max_extremum_ratio * range)) continue;
    const double sign = value > 0 ? 1.0 : -1.0, width = upper.first - lower.first, start = lower.first;
    bool exists = true;
    const auto signed_value = [&](double x) {
      double value = 0.0;
      exists = exists && function(start + (x - 1) * width, value);
      return sign * value;
    };
    const auto [x, minimum] = boost::math::tools::brent_find_minima(signed_value, 1.0, 2.0, kink_search_bits);
    if (!exists) return false;
    kinks_.emplace_back(start + (x - 1) * width, sign * minimum);
  }
  for (const auto& [t, value] : kinks_) insert_point(points_, t, value);
  return true;
}

bool RootSearch::find(const ScalarFunction& function, Interval step, In values, int sign_before, double zero_threshold,
                      const ScalarFunction* exact) {
  const double zero = std::max(zero_threshold, zero_rounding * values.cwiseAbs().maxCoeff());
  const Vector& positions = sample_points();
  const auto time_of = [&](Eigen::Index k) { return k + 1 == positions.size() ? step.to : step.at(positions(k)); };
  points_.clear();
  for (Eigen::Index k = 0; k < positions.size(); ++k) points_.emplace_back(time_of(k), values(k));
  if (!add_extrema(function, step, values, zero)) return false;
  bool may_touch = false;
  if (exact && !may_touch_zero(*exact, values.maxCoeff() - values.minCoeff(), points_, may_touch)) return false;
  if (may_touch) {
    exact_values_.resize(positions.size());
    for (Eigen::Index k = 0; k < positions.size(); ++k)
      if (!(*exact)(time_of(k), exact_values_(k))) return false;
    return find(*exact, step, exact_values_, sign_before, zero_threshold);
  }
  sign_changes.clear(), sign = sign_before, on_zero = false, always_on_zero = true;
  auto previous = points_.front();
  for (const auto& point : points_) {
    const int sign_here = std::abs(point.second) <= zero ? 0 : point.second > 0 ? 1 : -1;
    on_zero = sign_here == 0, always_on_zero &= sign_here == 0;
    if (sign_here && sign && sign != sign_here) {
      double t;
      if (!find_root(function, previous, point, t)) return false;
      if (exact && previous.second * point.second < 0.0 && !refine_root(function, *exact, previous, point, t))
        return false;
      sign_changes.emplace_back(t, sign_here);
    }
    if (sign_here) sign = sign_here, previous = point;
  }
  return true;
}

}  // namespace ckc
