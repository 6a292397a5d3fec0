// Fastest speed along a path under linear limits, as ckc_pin/optimization/speed_profile.py describes it: sweeps over the
// intervals of a grid, whose limits are rows A y + B b <= C of b at an interval's start and y at its end.
#include <algorithm>
#include <cmath>
#include <limits>

#include "bind/checks.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr int max_vertex_steps = 100;
constexpr double tolerance = 1e-11;  // relative: of what a limit may be exceeded by because of rounding
constexpr double infinity = std::numeric_limits<double>::infinity();

using Table = nb::ndarray<const double, nb::c_contig, nb::device::cpu, nb::ndim<2>>;

struct Row {
  double A, B, C;
};

// The rows of each interval.
class Rows {
 public:
  Rows(const Table& A, const Table& B, const Table& C) : count_(A.shape(0)), width_(A.shape(1)) {
    for (const Table* x : {&B, &C}) require(x->shape(0) == count_ && x->shape(1) == width_, "rows: wrong shape");
    rows_.reserve(count_ * width_);
    for (size_t k = 0; k < count_ * width_; ++k) rows_.push_back({A.data()[k], B.data()[k], C.data()[k]});
  }
  size_t size() const { return count_; }
  const Row* begin(size_t interval) const { return rows_.data() + interval * width_; }
  const Row* end(size_t interval) const { return begin(interval) + width_; }

 private:
  size_t count_, width_;
  std::vector<Row> rows_;
};

struct Vertex {
  double b, y;
};

// The largest (sign = 1) or smallest (sign = -1) b of the rows up to a bound, with a y of at most `largest_y` and at least
// `smallest_y`.
//
// The width in y of the feasible set is a concave function of b. Newton's method finds its zero from the outside.
Vertex find_vertex(const Row* begin, const Row* end, double bound, double sign, double smallest_y, double largest_y) {
  double b = bound;
  for (const Row* row = begin; row != end; ++row)
    if (row->A == 0.0 && sign * row->B > 0.0) b = sign * std::min(sign * b, sign * row->C / row->B);
  double above = infinity, below = -infinity;
  for (int step = 0; step < max_vertex_steps; ++step) {
    above = largest_y, below = smallest_y;
    double slope_above = 0.0, slope_below = 0.0;
    for (const Row* row = begin; row != end; ++row) {
      if (row->A == 0.0) continue;
      const double slope = row->B / row->A, y = row->C / row->A - slope * b;
      if (row->A > 0.0 && y < above) above = y, slope_above = slope;
      if (row->A < 0.0 && y > below) below = y, slope_below = slope;
    }
    const double width = above - below, change = slope_below - slope_above;
    if (!(width < 0.0 && sign * change < 0.0)) break;
    b -= width / change;
  }
  return {b, (above + below) / 2};
}

struct Range {
  double smallest, largest;
};

// The range of b of an interval for a y; empty if there is none.
Range range_of_b(const Row* begin, const Row* end, double largest, double y) {
  Range range{0.0, largest};
  for (const Row* row = begin; row != end; ++row) {
    const double rest = row->C - row->A * y;
    if (row->B > 0.0)
      range.largest = std::min(range.largest, rest / row->B);
    else if (row->B < 0.0)
      range.smallest = std::max(range.smallest, rest / row->B);
    else if (rest < -tolerance * (std::abs(row->C) + std::abs(row->A * y)))
      return {infinity, -infinity};
  }
  return range;
}

// The largest b at the points, or the number of an interval where no speed fulfils the limits, with the y there.
nb::tuple fastest_profile(const Table& A, const Table& B, const Table& C, VectorArg largest, double start, double end) {
  const Rows rows(A, B, C);
  const auto count = static_cast<Eigen::Index>(rows.size());
  require(largest, count + 1, "largest");
  const double rounding = tolerance * largest.maxCoeff();
  Vector smallest_b(count + 1), largest_b(count + 1), b(count + 1);
  smallest_b(count) = largest_b(count) = end;
  for (Eigen::Index k = count - 1; k >= 0; --k) {
    const Row *first = rows.begin(static_cast<size_t>(k)), *last = rows.end(static_cast<size_t>(k));
    const auto reachable = [&](double y) { return std::min(std::max(y, smallest_b(k + 1)), largest_b(k + 1)); };
    const double top = reachable(find_vertex(first, last, largest(k), 1.0, 0.0, largest(k + 1)).y),
                 bottom = reachable(find_vertex(first, last, 0.0, -1.0, 0.0, largest(k + 1)).y);
    const Range at_top = range_of_b(first, last, largest(k), top),
                at_bottom = range_of_b(first, last, largest(k), bottom);
    if (!(at_top.largest >= at_top.smallest - rounding && at_bottom.largest >= at_bottom.smallest - rounding))
      return nb::make_tuple(nb::none(), k, top);
    smallest_b(k) = at_bottom.smallest, largest_b(k) = std::max(at_top.largest, at_bottom.smallest);
  }
  if (!(smallest_b(0) - rounding <= start && start <= largest_b(0) + rounding))
    return nb::make_tuple(nb::none(), 0, largest_b(1));
  b(0) = start;
  for (Eigen::Index k = 0; k < count; ++k) {
    double y = largest_b(k + 1);
    for (const Row* row = rows.begin(static_cast<size_t>(k)); row != rows.end(static_cast<size_t>(k)); ++row)
      if (row->A > 0.0) y = std::min(y, (row->C - row->B * b(k)) / row->A);
    b(k + 1) = std::max({y, smallest_b(k + 1), 0.0});
  }
  return nb::make_tuple(b, -1, 0.0);
}

// The largest b up to a bound, by interval.
Vector largest_b(const Table& A, const Table& B, const Table& C, double bound) {
  const Rows rows(A, B, C);
  Vector result(static_cast<Eigen::Index>(rows.size()));
  for (size_t k = 0; k < rows.size(); ++k)
    result(static_cast<Eigen::Index>(k)) = find_vertex(rows.begin(k), rows.end(k), bound, 1.0, -infinity, infinity).b;
  return result;
}

}  // namespace

void bind_speed_profile(nb::module_& m) {
  m.def("fastest_profile", &fastest_profile, "A"_a, "B"_a, "C"_a, nb::kw_only(), "largest"_a, "start"_a, "end"_a,
        nb::sig("def fastest_profile(A: numpy.typing.NDArray[numpy.float64], B: numpy.typing.NDArray[numpy.float64], "
                "C: numpy.typing.NDArray[numpy.float64], *, largest: numpy.typing.NDArray[numpy.float64], "
                "start: float, end: float) -> tuple[numpy.typing.NDArray[numpy.float64] | None, int, float]"),
        "The largest b at the points of a grid under rows A y + B b <= C of each interval, from start to end. Without "
        "one: an interval in which no b fulfils the rows, and y there.");
  m.def("largest_b", &largest_b, "A"_a, "B"_a, "C"_a, nb::kw_only(), "bound"_a,
        nb::sig("def largest_b(A: numpy.typing.NDArray[numpy.float64], B: numpy.typing.NDArray[numpy.float64], "
                "C: numpy.typing.NDArray[numpy.float64], *, bound: float) -> numpy.typing.NDArray[numpy.float64]"),
        "The largest b up to a bound under rows A y + B b <= C with any y, for each group of rows.");
}

}  // namespace ckc
