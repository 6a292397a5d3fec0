// Singular positions, where J loses rank: they are detected within steps and ahead of them. If the formulation
// allows, a collocation step crosses them. Otherwise they end the run.
#pragma once

#include <memory>

#include "motion/collocation.hpp"
#include "motion/rank_monitor.hpp"

namespace ckc {

class Crossing {
 public:
  using Rank = RankMonitor::Rank;

  // `collocation`: null if singular positions are not crossed. `manifold_tolerance`: largest |phi| along a
  // collocation step.
  Crossing(System& system, Method*& method, Step& step, RankMonitor& monitor, std::unique_ptr<Collocation> collocation,
           double manifold_tolerance);

  void reset();  // after a discontinuity
  // Announce a time at which J loses rank.
  void expect_at(double t) { crossing_in_rejected_step_ = t; }
  // Time until J loses rank, after a step that ended in `end`; NaN if that is not near. Needs no right-hand side.
  double time_to_crossing(const Rank& end, double step_size, double t_bound);

  struct Verdict {
    double fraction;          // of the step to make: 1 to accept it, less to retry with a shorter one
    bool rank_lost = false;   // J loses rank within the step, and that cannot be crossed
    double t = 0, value = 0;  // its time, and the smallest singular value there
  };
  Verdict judge_step(const Rank& end, const Rank& after);
  // Step over a crossing. Returns its time, or NaN if it has to be approached first; the method's next step size is
  // set accordingly.
  double step_over(double time_left, double step_size);
  // Call after a step is accepted.
  void accept_step(const Rank& after) {
    if (after.rate > 0.0) attempts_ = 0;
  }

  const std::unique_ptr<Collocation> collocation;

 private:
  double step_from(double t, In y, double crossing);
  // Find the time at which J loses rank on a motion that sets y_, starting from t. NaN if not found.
  template <class Motion>
  double find_zero(const Motion& motion, double t, double accuracy);
  bool is_on_manifold();
  bool may_pass() const;

  System& system_;
  Method*& method_;
  Step& step_;
  RankMonitor& monitor_;
  double manifold_tolerance_;
  double crossing_in_rejected_step_;  // NaN if there is none
  double max_distance_;               // s; farther away no collocation step is expected to be accurate
  int attempts_ = 0;
  Vector y_;
};

}  // namespace ckc
