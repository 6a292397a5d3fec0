// Detects singular positions, where J loses rank, within steps and ahead of them. A collocation step crosses them if
// the formulation allows it. Otherwise they end the run.
#pragma once

#include <memory>
#include <optional>

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
  // Set a time at which J is known to lose rank.
  void expect_at(double t) { crossing_in_rejected_step_ = t; }
  // Time until J loses rank after a step that ended with `end`; NaN if no loss of rank is expected soon. Evaluates no
  // right-hand side.
  double time_to_crossing(const Rank& end, double step_size, double t_bound);

  struct Verdict {
    double fraction;          // 1: accept the step; less: retry with this fraction of it
    bool rank_lost = false;   // J loses rank within the step, and the position cannot be crossed
    double t = 0, value = 0;  // of that position: time, smallest singular value
  };
  Verdict judge_step(const Rank& end, const Rank& after);
  // Step over a crossing and return its time. If it has to be approached first, return NaN and set the next step size
  // of the method accordingly.
  double step_over(double time_left, double step_size);
  // Call after a step is accepted.
  void accept_step(const Rank& after) {
    if (after.rate > 0.0) attempts_ = 0, blocking_.reset();
  }

  // A position ahead that cannot be passed.
  struct Blocking {
    double t, value;          // time, smallest singular value
    double closest_approach;  // s; the run ends this near to it
  };
  const std::optional<Blocking>& blocking() const { return blocking_; }

  const std::unique_ptr<Collocation> collocation;

 private:
  double step_from(double t, In y, double crossing);
  // Find the time near t at which J loses rank along a motion, a function that sets y_. NaN if not found.
  template <class Motion>
  double find_zero(const Motion& motion, double t, double accuracy);
  bool is_on_manifold();
  bool may_pass() const;
  Verdict approach(double t, double value);

  System& system_;
  Method*& method_;
  Step& step_;
  RankMonitor& monitor_;
  double manifold_tolerance_;
  double crossing_in_rejected_step_;  // NaN if there is none
  double max_distance_;               // s; collocation steps from farther away are not expected to be accurate
  std::optional<Blocking> blocking_;
  int attempts_ = 0;
  Vector y_;
};

}  // namespace ckc
