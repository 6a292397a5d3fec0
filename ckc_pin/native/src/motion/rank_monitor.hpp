// Monitors J for a loss of rank, where branches of the motion meet.
//
// At a change point (such as a flat four-bar) the loops do not determine the motion. A step across it may end on the
// other branch, within tolerance but wrong. The smallest singular value s(t) of J then has the shape of a V that
// reaches zero: it falls at the start of the step and rises at its end. In such steps its minimum is searched.
#pragma once

#include <limits>

#include <boost/math/tools/minima.hpp>

#include "loops/spectrum.hpp"
#include "motion/system.hpp"

namespace ckc {

class RankMonitor {
 public:
  explicit RankMonitor(const Core& core);

  // Smallest nonzero singular value of J over the root mean square of all of them, dimensionless, and its rate.
  struct Rank {
    double value = 1.0, rate = 0.0;
  };
  Rank evaluate(System& system);  // at the core's state, moving with system.velocity
  // Whether J has two rows, for which there is a closed form (loops/two_rows.hpp).
  static bool has_two_rows(const Core& core) { return core.rank == 2 && core.constraints.closure.rows == 2; }
  void reset() { smallest_singular_value_.forget_vector(); }  // before a run: forget the last one

  static bool has_rank(const Rank& rank) { return rank.value >= rank_lost && std::isfinite(rank.rate); }
  // Whether a loss of rank of J may lie within this time.
  static bool may_lose_rank_within(const Rank& end, double time);
  // Fraction of a step of size h that can be accepted, given the values at its ends: 1 if it contains no loss of
  // rank, less if it is too long to tell, NaN if the interior must be searched.
  static double step_fraction(const Rank& before, const Rank& after, double h);
  // The same if the minimum within the step is known and larger than `rank_lost`.
  static double step_fraction(const Rank& before, const Rank& after, double h, double minimum);

  static constexpr double rank_lost = 1e-5;

  // Find the minimum of the value along a motion, with an accuracy of 2^(1 - bits) of the interval.
  struct Minimum {
    double t, value;
  };
  // `motion` sets the core to the configuration at a time; false if that does not exist.
  template <class Motion>
  Minimum find_minimum(Core& core, const Motion& motion, double from, double to, int bits) {
    const double h = to - from;
    const auto value = [&](double x) {
      return motion(from + (x - 1) * h) ? this->value(core) : std::numeric_limits<double>::infinity();
    };
    const auto [x, minimum] = boost::math::tools::brent_find_minima(value, 1.0, 2.0, bits);
    return {from + (x - 1) * h, minimum};
  }

 private:
  double value(Core& core);

  Vector v_, u_;
  SmallestSingularValue smallest_singular_value_;  // of the scaled J
};

}  // namespace ckc
