// Positions where J loses rank: seen within steps and ahead of them, passed by a collocation step where the formulation
// does not need the branch from J, or reported as the end of the run.
#pragma once

#include <memory>

#include "motion/collocation.hpp"
#include "motion/rank_monitor.hpp"

namespace ckc {

class Crossing {
 public:
  using Rank = RankMonitor::Rank;

  // `collocation`: null where no position is passed; `closed`: how closed the loops stay along a collocation step.
  Crossing(System& system, Method*& method, Step& step, RankMonitor& monitor, std::unique_ptr<Collocation> collocation,
           double closed);

  void begin();  // from a state that something else came to
  // Learn when J is about to lose rank.
  void expect(double t) { inside_ = t; }
  // Time until J loses rank, for a step that ended in `end`; NaN when that is not near. Costs no right-hand side.
  double left(const Rank& end, double length, double t_bound);

  struct Verdict {
    double part;               // of the step to make: 1 where it stands, less where a shorter one is to be tried
    bool lost = false;         // J loses rank in it, and that cannot be passed:
    double t = 0, value = 0;   // when, and its least singular value there
  };
  Verdict judge(const Rank& end, const Rank& after);
  // Step over a crossing; when J lost rank, NaN where it has to be approached first: the method's next step is as long
  // as that asks then.
  double over(double left, double length);
  // Learn of a step that was kept.
  void kept(const Rank& after) {
    if (after.rate > 0.0) attempts_ = 0;
  }

  const std::unique_ptr<Collocation> collocation;

 private:
  double from(double t, In y, double crossing);
  // When J loses rank on a motion that sets y_, from t on; NaN where that is not found.
  template <class Motion>
  double zero(const Motion& motion, double t, double accuracy);
  bool closed();
  bool passes() const;

  System& system_;
  Method*& method_;
  Step& step_;
  RankMonitor& monitor_;
  double closed_;
  double inside_;  // within a step that was not kept; else NaN
  double reach_;   // s; from farther away no collocation step is expected to be accurate
  int attempts_ = 0;
  Vector y_;
};

}  // namespace ckc
