// Monitors J for a loss of rank, where branches of the motion meet.
//
// At a change point (a flat four-bar) the loops stop to determine the motion: a step that passes over it can come out
// on the other branch, within tolerance and wrong. The least singular value s(t) of J shows it as a V that reaches zero:
// falling at the start of a step, rising at its end. In such a step the least value is searched for.
#pragma once

#include <limits>

#include <boost/math/tools/minima.hpp>

#include "loops/spectrum.hpp"
#include "motion/system.hpp"

namespace ckc {

class RankMonitor {
 public:
  explicit RankMonitor(const Core& core);

  // J's least singular value that is not zero over the root mean square of all such, free of units, and its rate.
  struct Rank {
    double value = 1.0, rate = 0.0;
  };
  Rank at(System& system);  // at the core's present state, moving with system.velocity

  // Whether J has kept its rank.
  static bool kept(const Rank& at) { return at.value >= lost && std::isfinite(at.rate); }
  // Whether a position where J loses rank may be so near that it has to be looked for.
  static bool ahead(const Rank& end, double length);
  // How much of a step of length h between two values to make: all where it passes no loss of rank, a part where it is
  // too long to tell; NaN where only what is between its ends tells.
  static double part(const Rank& before, const Rank& after, double h);
  // The same of a step of which the least value in between is known, and is above `lost`.
  static double part(const Rank& before, const Rank& after, double h, double least);

  static constexpr double lost = 1e-5;

  // When that value is least on a motion, to 2^(1 - bits) of the interval, and how large it is then.
  struct Least {
    double t, value;
  };
  // `motion`: sets the core to where it is at an instant; false where it does not exist.
  template <class Motion>
  Least least(Core& core, const Motion& motion, double from, double to, int bits) {
    const double h = to - from;
    const auto value = [&](double x) {
      return motion(from + (x - 1) * h) ? this->value(core) : std::numeric_limits<double>::infinity();
    };
    const auto [x, least] = boost::math::tools::brent_find_minima(value, 1.0, 2.0, bits);
    return {from + (x - 1) * h, least};
  }

 private:
  double value(Core& core);

  Vector v_, u_;
  Spectrum spectrum_;  // of J, scaled
};

}  // namespace ckc
