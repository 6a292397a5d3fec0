// Watches for J losing rank and phi_z becoming singular, after every step: whether all is plainly well.
//
// What is to be done where it is not is for `Crossing` or for Python (`simulation.rank_guard`, `LevelSet.accept`).
#pragma once

#include <limits>

#include <boost/math/tools/minima.hpp>

#include "spectrum.hpp"
#include "system.hpp"

namespace ckc {

class Watch {
 public:
  // Scales that make J free of units.
  Watch(const Core& core, In row_scale, In column_scale);

  double chart_margin = 0.0;  // of phi_z, relative to |J|, from which on Python looks after it

  // J's least singular value that is not zero relative to the largest, and its rate, at the core's present state.
  struct Rank {
    double value = 0.0, rate = 0.0;
  };

  Rank rank(System& system);
  bool chart(const Core& core);  // whether phi_z is far enough from singular
  // Whether J is far enough from losing rank for that to be exact.
  bool plain(const Rank& at) const;
  // Whether a position where J loses rank may be so near that it has to be looked for.
  bool ahead(const Rank& end, double length) const;
  // How much of a step of length h between two such values to make: all where it passes no loss of rank, a part where
  // it is too long to tell, none where only what is between its ends tells.
  double part(const Rank& before, const Rank& after, double h) const;
  // The same of a step of which the least value in between is known.
  double part(const Rank& before, const Rank& after, double h, double least) const;

  // When that value is least on a motion, to 2^(1 - bits) of the interval, and how large it is then.
  struct Least {
    double t, value;
  };
  // `motion`: sets the core to where it is at an instant, with J; false where it does not exist.
  template <class Motion>
  Least least(const Core& core, const Motion& motion, double from, double to, int bits) {
    const double h = to - from;
    const auto value = [&](double x) {
      return motion(from + (x - 1) * h) ? at(core) : std::numeric_limits<double>::infinity();
    };
    const auto [x, least] = boost::math::tools::brent_find_minima(value, 1.0, 2.0, bits);
    return {from + (x - 1) * h, least};
  }

 private:
  double at(const Core& core);   // the value alone

  Vector row_scale_, column_scale_, v_, u_;
  Matrix phi_z_, phi_z_gram_;
  Spectrum spectrum_;                                  // of J, scaled
  Eigen::SelfAdjointEigenSolver<Matrix> chart_eigen_;  // values only: vectors would allocate
};

}  // namespace ckc
