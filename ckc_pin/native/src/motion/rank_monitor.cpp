#include "motion/rank_monitor.hpp"
#include "loops/two_rows.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

// Relative to the larger value at the ends. A V whose tangents meet below the first bound is searched for its minimum.
// A minimum below the second has to be resolved by shorter steps.
constexpr double max_valley_ratio = 0.7, max_minimum_ratio = 0.2;
// Longest step that begins and ends with falling s, relative to the time to s = 0 along the tangent.
constexpr double max_zero_time_ratio = 0.7;
constexpr double min_resolved_step = 1e-6;  // s; shorter steps resolve any gap between branches wider than `rank_lost`

RankMonitor::RankMonitor(const Core& core) : smallest_singular_value_(core.constraints.pattern, core.n, core.rank) {
  u_.setZero(core.constraints.closure.rows), v_.setZero(core.n);
}

double RankMonitor::value(Core& core) {
  core.compute_J();
  smallest_singular_value_.compute(core.constraints.J(), core.scales.rows, core.scales.columns, true);
  return smallest_singular_value_.value() / smallest_singular_value_.root_mean_square();
}

RankMonitor::Rank RankMonitor::evaluate(System& system) {
  Core& core = system.core;
  if (core.rank == 0) return {};
  core.compute_J();
  core.compute_J_dot(system.velocity);
  if (has_two_rows(core)) {
    Rank rank;
    find_rank_of_two_rows(core.constraints.J().data(), core.constraints.J_dot.data(), core.scales.rows.data(),
                          core.scales.columns.data(), core.n, rank.value, rank.rate);
    return rank;
  }
  smallest_singular_value_.compute(core.constraints.J(), core.scales.rows, core.scales.columns, true);
  smallest_singular_value_.compute_vectors(u_, v_);
  const double singular_value = v_.norm(), mean = smallest_singular_value_.root_mean_square();
  v_.array() *= core.scales.columns.array();
  u_.array() *= core.scales.rows.array();
  double rate = 0.0;
  for (Eigen::Index i = 0; i < u_.size(); ++i)
    for (int j : core.constraints.pattern[i]) rate += u_(i) * core.constraints.J_dot(i, j) * v_(j);
  return {singular_value / mean, rate / std::max(singular_value, 1e-300) / mean};
}

bool RankMonitor::may_lose_rank_within(const Rank& end, double time) {
  return end.rate < 0.0 && end.value <= -time * end.rate;
}

double RankMonitor::step_fraction(const Rank& before, const Rank& after, double h) {
  if (before.rate < 0.0 && after.rate > 0.0) {  // a V: where the tangents at both ends meet
    const double meeting_time = (after.value - before.value - after.rate * h) / (before.rate - after.rate);
    return before.value + before.rate * meeting_time < max_valley_ratio * std::max(before.value, after.value)
               ? std::nan("")
               : 1.0;
  }
  // Between the ends s may fall to zero, rise to a peak and fall again, or rise to a peak, fall to zero and rise again.
  const bool passes_zero = before.rate < 0.0 ? h > max_zero_time_ratio * before.value / -before.rate
                                             : after.rate > 0.0 && h * after.rate > after.value;
  return passes_zero && h > min_resolved_step ? 0.5 : 1.0;
}

double RankMonitor::step_fraction(const Rank& before, const Rank& after, double h, double minimum) {
  return minimum < max_minimum_ratio * std::max(before.value, after.value) && h > min_resolved_step ? 0.25 : 1.0;
}

}  // namespace ckc
