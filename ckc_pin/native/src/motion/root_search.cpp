// Sign changes of a function within a step.
#include "motion/events.hpp"

#include <algorithm>
#include <cmath>

#include <boost/math/tools/minima.hpp>
#include <boost/math/tools/toms748_solve.hpp>

namespace ckc {

constexpr double rounding = 1e-12;    // of the largest value in the step: counts as zero
constexpr double near_zero = 0.25;    // of the function's range in the step: an extremum so near to zero is refined
constexpr double t_tolerance = 1e-12; // s
constexpr int most_steps = 6;         // of the secant method from a root that is nearly right,
constexpr double secant = 1e-3;       // of the step: over which it begins; of its first step, what that may be wrong by
constexpr int fine = 64;              // places at which the polynomial's extrema are looked for
constexpr int tip_bits = 30;          // how closely the tip of a kink is searched for
constexpr double unsure = 10.0;       // times what the cheap function is off by: an extremum so near to zero may cross

namespace {

// From values at the places to Chebyshev coefficients, and from those to the fine places.
struct Chebyshev {
  Matrix to_fine;
  Vector fine_places;
  Chebyshev() {
    const int n = walk_degree;
    const auto polynomials = [](const Vector& x) {
      Matrix values(x.size(), walk_degree + 1);
      for (Eigen::Index i = 0; i < x.size(); ++i)
        for (int k = 0; k <= walk_degree; ++k) values(i, k) = std::cos(k * std::acos(std::clamp(x(i), -1.0, 1.0)));
      return values;
    };
    const Vector x = 2 * walk_places().array() - 1;
    fine_places = Vector::LinSpaced(n * fine + 1, 0.0, 1.0);
    to_fine = polynomials(2 * fine_places.array() - 1) * polynomials(x).inverse();
  }
};

const Chebyshev& chebyshev() {
  static const Chebyshev once;
  return once;
}

void insert(Points& points, double t, double value) {
  const auto at = std::lower_bound(points.begin(), points.end(), t, [](const auto& p, double t) { return p.first < t; });
  if (at == points.end() || at->first != t) points.insert(at, {t, value});
}

// Add the points between the given ones where the function comes nearest to zero.
bool with_extrema(const Gap& gap, double from, double to, In values, double zero, Walk& walked) {
  Points &points = walked.points, &tips = walked.tips;
  const double spread = values.maxCoeff() - values.minCoeff();
  if (!(values.cwiseAbs().minCoeff() <= spread)) return true;  // too far from zero to reach it and come back
  Vector& curve = walked.curve;
  curve.noalias() = chebyshev().to_fine * values;
  for (Eigen::Index i = 1; i + 1 < curve.size(); ++i) {
    const double before = curve(i) - curve(i - 1), after = curve(i + 1) - curve(i);
    if (!(before * after < 0.0)) continue;
    const double step = chebyshev().fine_places(1), shift = 0.5 * (before + after) / (before - after);
    const double t = from + (to - from) * (chebyshev().fine_places(i) + shift * step);
    double value;
    if (!gap(t, value)) return false;
    insert(points, t, value);
  }
  tips.clear();
  for (size_t k = 0; k < points.size(); ++k) {
    const auto& [t, value] = points[k];
    const auto &left = points[k ? k - 1 : 0], &right = points[std::min(k + 1, points.size() - 1)];
    const bool nearest = value * left.second > 0 && value * right.second > 0 &&
                         std::abs(value) <= std::abs(left.second) && std::abs(value) <= std::abs(right.second);
    if (!nearest || !(std::abs(value) > zero) || !(std::abs(value) < near_zero * spread)) continue;
    const double sign = value > 0 ? 1.0 : -1.0, width = right.first - left.first, start = left.first;
    bool exists = true;
    const auto height = [&](double x) {
      double found = 0.0;
      exists = exists && gap(start + (x - 1) * width, found);
      return sign * found;
    };
    const auto [x, least] = boost::math::tools::brent_find_minima(height, 1.0, 2.0, tip_bits);
    if (!exists) return false;
    tips.emplace_back(start + (x - 1) * width, sign * least);
  }
  for (const auto& [t, value] : tips) insert(points, t, value);
  return true;
}

bool root(const Gap& gap, const std::pair<double, double>& start, const std::pair<double, double>& end, double& t) {
  t = start.first;
  if (start.second * end.second >= 0) return true;  // zero at the start of the step, or by what counts as zero
  bool exists = true;
  const auto value = [&](double at) {
    double found = start.second;
    exists = exists && gap(at, found);
    return found;
  };
  const auto close = [](double a, double b) {
    return std::abs(b - a) <= t_tolerance + 4 * std::numeric_limits<double>::epsilon() * std::abs(a);
  };
  std::uintmax_t most = 200;
  const auto [a, b] = boost::math::tools::toms748_solve(value, start.first, end.first, start.second, end.second, close, most);
  t = 0.5 * (a + b);
  return exists;
}

// From a root of `gap` to the one next to it of the function that gap is off from by little.
bool refine(const Gap& gap, const Gap& exact, const std::pair<double, double>& start,
            const std::pair<double, double>& end, double& t) {
  const double width = secant * (end.first - start.first), rough = t;
  const double left = std::max(t - width, start.first), right = std::min(t + width, end.first);
  double below, above;
  if (!gap(left, below) || !gap(right, above)) return false;
  double slope = (above - below) / (right - left), at = t, before = t, value_before = 0.0, value;
  for (int k = 0; k < most_steps && slope * end.second > 0.0; ++k) {
    if (!exact(at, value)) return false;
    if (k && value != value_before) slope = (value - value_before) / (at - before);
    const double step = value / slope, accuracy = t_tolerance + 4 * std::numeric_limits<double>::epsilon() * std::abs(at);
    before = at, value_before = value;
    at = std::clamp(at - step, start.first, end.first);
    if (!(std::abs(step) * (k ? 1.0 : secant) > accuracy)) return t = at, true;
  }
  double first, last;
  if (!exact(start.first, first) || !exact(end.first, last)) return false;
  t = rough;
  return first * last < 0.0 ? root(exact, {start.first, first}, {end.first, last}, t) : true;
}

// Whether the function that gap is off from by little may touch zero where gap does not, or not where gap does.
bool grazes(const Gap& exact, double spread, const Points& points, bool& may) {
  may = false;
  for (size_t k = 1; k + 1 < points.size() && !may; ++k) {
    const auto& [t, value] = points[k];
    const bool extreme = (value - points[k - 1].second) * (value - points[k + 1].second) >= 0.0;
    if (!extreme || !(std::abs(value) < near_zero * spread)) continue;
    double there;
    if (!exact(t, there)) return false;
    may = std::abs(value) <= unsure * std::abs(there - value);
  }
  return true;
}

}  // namespace

const Vector& walk_places() {
  static const Vector once =
      Vector::NullaryExpr(walk_degree + 1, [](Eigen::Index k) { return (1.0 - std::cos(M_PI * k / walk_degree)) / 2; });
  return once;
}

bool walk(const Gap& gap, double from, double to, In values, int sign, double floor, Walk& walked, const Gap* exact) {
  const double zero = std::max(floor, rounding * values.cwiseAbs().maxCoeff());
  const Vector& places = walk_places();
  Points& points = walked.points;
  points.clear();
  for (Eigen::Index k = 0; k < places.size(); ++k)
    points.emplace_back(k + 1 == places.size() ? to : from + (to - from) * places(k), values(k));
  if (!with_extrema(gap, from, to, values, zero, walked)) return false;
  bool may = false;
  if (exact && !grazes(*exact, values.maxCoeff() - values.minCoeff(), points, may)) return false;
  if (may) {
    Vector& exact_values = walked.exact_values;
    exact_values.resize(places.size());
    for (Eigen::Index k = 0; k < places.size(); ++k)
      if (!(*exact)(k + 1 == places.size() ? to : from + (to - from) * places(k), exact_values(k))) return false;
    return walk(*exact, from, to, exact_values, sign, floor, walked);
  }
  walked.found.clear(), walked.sign = sign, walked.on_zero = false, walked.always_on_zero = true;
  auto last = points.front();
  for (const auto& point : points) {
    const int now = std::abs(point.second) <= zero ? 0 : point.second > 0 ? 1 : -1;
    walked.on_zero = now == 0, walked.always_on_zero &= now == 0;
    if (now && walked.sign && walked.sign != now) {
      double t;
      if (!root(gap, last, point, t)) return false;
      if (exact && last.second * point.second < 0.0 && !refine(gap, *exact, last, point, t)) return false;
      walked.found.emplace_back(t, now);
    }
    if (now) walked.sign = now, last = point;
  }
  return true;
}

}  // namespace ckc
