// Positions where J loses rank: seen within steps and ahead of them, and leapt over, as in `simulation.rank_guard`.
#pragma once

#include <memory>

#include "leap.hpp"
#include "method.hpp"
#include "watch.hpp"

namespace ckc {

class Crossing {
 public:
  // `leap`: null where crossings are Python's; `closed`: how closed the loops stay along a leap.
  Crossing(System& system, Method& method, Watch& watch, std::unique_ptr<Leap> leap, double closed);

  // Begin from a state that something else came to.
  void begin();
  // Time until J loses rank, for a step that ended in `end`; NaN when that is not near.
  double left(const Watch::Rank& end, double length, double t_bound);
  // How much of the method's step to make, looking within it where its ends do not tell.
  double part(const Watch::Rank& end, const Watch::Rank& after, double h);
  // Leap over a crossing; when J lost rank, NaN where it has to be approached first: the method's next step is as long
  // as that asks then.
  double over(double left, double length);
  // Learn of a step that was kept.
  void kept(const Watch::Rank& after) {
    if (after.rate > 0.0) attempts_ = 0;
  }

  const std::unique_ptr<Leap> leap;

 private:
  double from(double t, In y, double crossing);
  // When J loses rank on a motion that sets y_, from t on; NaN where that is not found.
  template <class Motion>
  double zero(const Motion& motion, double t, double accuracy);
  bool closed();
  void approach(double left);

  System& system_;
  Method& method_;
  Watch& watch_;
  double closed_;
  double inside_;  // within a step that was not kept; else NaN
  double reach_;   // s; from farther away no leap is expected to be accurate
  int attempts_ = 0;
  Vector y_;
};

}  // namespace ckc
