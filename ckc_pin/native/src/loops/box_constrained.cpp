#include "loops/box_constrained.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/QR>
#include <proxsuite/proxqp/dense/dense.hpp>

namespace ckc {

namespace qp = proxsuite::proxqp;

constexpr double exactly = 1e-12;  // of the program, whose numbers are about one
constexpr double accepted = 1e-11; // of the largest number of x: how far it may be from optimal
constexpr double at_bound = 1e-9;  // of the largest number of x: so close to its bound a number is at it
constexpr double far = 1e8;        // a bound that is never met
constexpr long most_iterations = 10000;
constexpr double parallel = 1e-12;  // of a direction whose rows are about one: it does not move along

namespace {

// How far x is from what a step along the gradient makes of it within the box: zero at the minimum.
double residual(const Matrix& A, In b, In lower, In upper, const Vector& x) {
  const Vector gradient = A * x + b;
  return (x - (x - gradient).cwiseMax(lower).cwiseMin(upper)).lpNorm<Eigen::Infinity>();
}

// Solve for the numbers that are off their bounds once more, to rounding: the smallest ones, or those next to x.
void polish(const Matrix& A, In b, In lower, In upper, Vector& x) {
  const double apart = at_bound * std::max(1.0, x.lpNorm<Eigen::Infinity>());
  Indices inside;
  Vector bound = x;
  for (Eigen::Index i = 0; i < x.size(); ++i)
    if (x(i) - lower(i) > apart && upper(i) - x(i) > apart) inside.push_back(static_cast<int>(i)), bound(i) = 0.0;
  if (inside.empty()) return;
  Eigen::CompleteOrthogonalDecomposition<Matrix> factors;
  factors.setThreshold(parallel);
  factors.compute(A(inside, inside));
  for (const Vector& from : {bound, x}) {
    const Vector gradient = A * from + b;
    Vector polished = from;
    polished(inside) -= factors.solve(gradient(inside));
    polished = polished.cwiseMax(lower).cwiseMin(upper);
    if (residual(A, b, lower, upper, polished) <= std::max(residual(A, b, lower, upper, x), exactly)) {
      x = polished;
      return;
    }
  }
}

}  // namespace

bool least_in_box(const Matrix& A, In b, In lower, In upper, Vector& x) {
  const auto n = A.rows();
  if (n == 1 && A(0, 0) > 0.0) {
    x.setConstant(1, std::min(std::max(-b(0) / A(0, 0), lower(0)), upper(0)));
    return true;
  }
  qp::dense::QP<double> program(n, 0, 0, true);
  program.settings.eps_abs = exactly, program.settings.eps_rel = 0.0;
  program.settings.max_iter = most_iterations;
  const auto none = proxsuite::nullopt;
  const Vector cost = b, low = lower.cwiseMax(-far), high = upper.cwiseMin(far);
  program.init(A, cost, none, none, none, none, none, low, high);
  program.solve();
  x = program.results.x.cwiseMax(lower).cwiseMin(upper);
  if (!x.allFinite()) return false;
  polish(A, b, lower, upper, x);
  const bool solved = program.results.info.status == qp::QPSolverOutput::PROXQP_SOLVED;
  return solved || residual(A, b, lower, upper, x) <= accepted * std::max(1.0, x.lpNorm<Eigen::Infinity>());
}

// A linear program in (x, s), at most a few unknowns, from the feasible point x = 0 by an active-set method: go along the
// working set's null space while s grows, then leave the row with the first negative multiplier (Bland's rule).
double largest_slack(const Matrix& N, In y, In lower, In upper) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Eigen::Index m = N.rows(), size = N.cols() + 1;
  Matrix rows(2 * m, size);  // rows (x, s) <= limits
  Vector limits(2 * m);
  Eigen::Index count = 0;
  const auto limit = [&](Eigen::Index i, double side, double room) {
    if (!std::isfinite(room)) return;
    rows.row(count) << side * N.row(i), 1.0;
    limits(count) = room;
    ++count;
  };
  for (Eigen::Index i = 0; i < m; ++i) limit(i, 1.0, upper(i) - y(i)), limit(i, -1.0, y(i) - lower(i));
  if (!count) return infinity;
  Vector point = Vector::Zero(size);
  Eigen::Index first;
  point(size - 1) = limits.head(count).minCoeff(&first);
  std::vector<Eigen::Index> working{first};
  const Vector objective = Vector::Unit(size, size - 1);
  const long most = 50 * (count + size);
  for (long k = 0; k < most; ++k) {
    Matrix active(size, static_cast<Eigen::Index>(working.size()));
    for (size_t i = 0; i < working.size(); ++i) active.col(static_cast<Eigen::Index>(i)) = rows.row(working[i]).transpose();
    const Eigen::ColPivHouseholderQR<Matrix> qr(active);
    const Vector multipliers = qr.solve(objective);
    const Vector direction = objective - active * multipliers;
    if (direction.norm() <= parallel) {
      size_t leaving = working.size();
      for (size_t i = 0; i < working.size(); ++i)
        if (multipliers(static_cast<Eigen::Index>(i)) < -parallel && (leaving == working.size() || working[i] < working[leaving]))
          leaving = i;
      if (leaving == working.size()) break;
      working.erase(working.begin() + static_cast<std::ptrdiff_t>(leaving));
      continue;
    }
    double step = infinity;
    Eigen::Index blocking = -1;
    for (Eigen::Index i = 0; i < count; ++i) {
      const double rate = rows.row(i).dot(direction);
      if (!(rate > parallel) || std::find(working.begin(), working.end(), i) != working.end()) continue;
      const double room = std::max(limits(i) - rows.row(i).dot(point), 0.0) / rate;
      if (room < step) step = room, blocking = i;
    }
    if (blocking < 0) return infinity;
    point += step * direction;
    working.push_back(blocking);
  }
  return point(size - 1);
}

}  // namespace ckc
