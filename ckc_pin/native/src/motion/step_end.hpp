// The end of a step of a member of an ensemble, computed with those of others (LaneEnds).
#pragma once

#include "motion/rank_monitor.hpp"

namespace ckc {

struct StepEnd {
  double t = std::nan(""), t_new = std::nan("");  // s, of the step; NaN if its end was not computed
  RankMonitor::Rank rank;
  double energy = 0.0;            // J
  double energy_allowance = 0.0;  // J, least change of the energy that errors within the tolerances cause
  Vector y;                       // the state, projected onto the constraint manifold
  bool is_projected = false;      // whether that has changed it
  long newton_steps = 0;
};

}  // namespace ckc
