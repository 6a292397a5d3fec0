#include "loops/box_constrained.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/QR>
#include <proxsuite/proxqp/dense/dense.hpp>

namespace ckc {

namespace qp = proxsuite::proxqp;

constexpr double solver_tolerance = 1e-12;  // the problem is scaled so that its numbers are about one
constexpr double max_residual = 1e-11;      // accepted optimality residual, relative to the largest |x|
constexpr double bound_tolerance = 1e-9;    // a variable this close to its bound is at it; relative to the largest |x|
constexpr double infinite_bound = 1e8;      // replaces infinite bounds, which ProxQP does not accept
constexpr long max_iterations = 10000;
constexpr double direction_tolerance = 1e-12;  // shorter combinations of rows, whose norms are about one, are zero

namespace {

// Optimality residual: the change of x by one projected gradient step. It is zero at the minimum.
double residual(const Matrix& A, In b, In lower, In upper, const Vector& x) {
  const Vector gradient = A * x + b;
  return (x - (x - gradient).cwiseMax(lower).cwiseMin(upper)).lpNorm<Eigen::Infinity>();
}

// Improve x to rounding: solve again for the variables that are not at their bounds. If A is singular, the minimum-norm
// solution is tried first, then the one closest to x.
void refine(const Matrix& A, In b, In lower, In upper, Vector& x) {
  const double tolerance = bound_tolerance * std::max(1.0, x.lpNorm<Eigen::Infinity>());
  Indices free;
  Vector bound = x;
  for (Eigen::Index i = 0; i < x.size(); ++i)
    if (x(i) - lower(i) > tolerance && upper(i) - x(i) > tolerance) free.push_back(static_cast<int>(i)), bound(i) = 0.0;
  if (free.empty()) return;
  Eigen::CompleteOrthogonalDecomposition<Matrix> factorization;
  factorization.setThreshold(direction_tolerance);
  factorization.compute(A(free, free));
  for (const Vector& start : {bound, x}) {
    const Vector gradient = A * start + b;
    Vector refined = start;
    refined(free) -= factorization.solve(gradient(free));
    refined = refined.cwiseMax(lower).cwiseMin(upper);
    if (residual(A, b, lower, upper, refined) <= std::max(residual(A, b, lower, upper, x), solver_tolerance)) {
      x = refined;
      return;
    }
  }
}

}  // namespace

bool minimize_in_box(const Matrix& A, In b, In lower, In upper, Vector& x) {
  const auto n = A.rows();
  if (n == 1 && A(0, 0) > 0.0) {
    x.setConstant(1, std::min(std::max(-b(0) / A(0, 0), lower(0)), upper(0)));
    return true;
  }
  qp::dense::QP<double> program(n, 0, 0, true);
  program.settings.eps_abs = solver_tolerance, program.settings.eps_rel = 0.0;
  program.settings.max_iter = max_iterations;
  const auto none = proxsuite::nullopt;
  const Matrix symmetric = 0.5 * (A + A.transpose());  // to the last digit, as ProxQP requires
  const Vector cost = b, low = lower.cwiseMax(-infinite_bound), high = upper.cwiseMin(infinite_bound);
  program.init(symmetric, cost, none, none, none, none, none, low, high);
  program.solve();
  x = program.results.x.cwiseMax(lower).cwiseMin(upper);
  if (!x.allFinite()) return false;
  refine(A, b, lower, upper, x);
  const bool solved = program.results.info.status == qp::QPSolverOutput::PROXQP_SOLVED;
  return solved || residual(A, b, lower, upper, x) <= max_residual * std::max(1.0, x.lpNorm<Eigen::Infinity>());
}

// A linear program in (x, s), solved with an active-set method from the feasible point x = 0. Follow the null space
// of the working set while s grows, then drop the first row with a negative multiplier (Bland's rule).
double maximize_bound_distance(const Matrix& N, In y, In lower, In upper) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Eigen::Index m = N.rows(), size = N.cols() + 1;
  Matrix rows(2 * m, size);  // rows (x, s) <= limits
  Vector limits(2 * m);
  Eigen::Index count = 0;
  const auto add_limit = [&](Eigen::Index i, double side, double distance) {
    if (!std::isfinite(distance)) return;
    rows.row(count) << side * N.row(i), 1.0;
    limits(count) = distance;
    ++count;
  };
  for (Eigen::Index i = 0; i < m; ++i) add_limit(i, 1.0, upper(i) - y(i)), add_limit(i, -1.0, y(i) - lower(i));
  if (!count) return infinity;
  Vector point = Vector::Zero(size);
  Eigen::Index first;
  point(size - 1) = limits.head(count).minCoeff(&first);
  std::vector<Eigen::Index> working{first};
  const Vector objective = Vector::Unit(size, size - 1);
  const long max_steps = 50 * (count + size);
  for (long k = 0; k < max_steps; ++k) {
    Matrix active(size, static_cast<Eigen::Index>(working.size()));
    for (size_t i = 0; i < working.size(); ++i)
      active.col(static_cast<Eigen::Index>(i)) = rows.row(working[i]).transpose();
    const Eigen::ColPivHouseholderQR<Matrix> qr(active);
    const Vector multipliers = qr.solve(objective);
    const Vector direction = objective - active * multipliers;
    if (direction.norm() <= direction_tolerance) {
      size_t leaving = working.size();
      for (size_t i = 0; i < working.size(); ++i)
        if (multipliers(static_cast<Eigen::Index>(i)) < -direction_tolerance &&
            (leaving == working.size() || working[i] < working[leaving]))
          leaving = i;
      if (leaving == working.size()) break;
      working.erase(working.begin() + static_cast<std::ptrdiff_t>(leaving));
      continue;
    }
    double step = infinity;
    Eigen::Index blocking = -1;
    for (Eigen::Index i = 0; i < count; ++i) {
      const double rate = rows.row(i).dot(direction);
      if (!(rate > direction_tolerance) || std::find(working.begin(), working.end(), i) != working.end()) continue;
      const double step_to_limit = std::max(limits(i) - rows.row(i).dot(point), 0.0) / rate;
      if (step_to_limit < step) step = step_to_limit, blocking = i;
    }
    if (blocking < 0) return infinity;
    point += step * direction;
    working.push_back(blocking);
  }
  return point(size - 1);
}

}  // namespace ckc
