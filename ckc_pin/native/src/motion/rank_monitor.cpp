#include "motion/rank_monitor.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

// Of the larger end value: a V whose tangents meet below that is looked into; a least value below that has to be
// resolved by shorter steps.
constexpr double deep = 0.7, neck = 0.2;
constexpr double jump = 0.7;  // of the time to s = 0 along its tangent: the longest step that begins and ends falling
constexpr double steps_ahead = 4.0;  // a crossing that is as near as that is looked for
constexpr double shortest = 1e-6;    // s; a step below that resolves any neck that is wider than `lost`

RankMonitor::RankMonitor(const Core& core) : spectrum_(core.rows.pattern, core.n, core.rank) {
  u_.setZero(core.rows.closure.rows), v_.setZero(core.n);
}

double RankMonitor::value(Core& core) {
  core.jacobian();
  spectrum_.compute(core.rows.J, core.scales.rows, core.scales.columns);
  return spectrum_.least() / spectrum_.mean();
}

RankMonitor::Rank RankMonitor::at(System& system) {
  Core& core = system.core;
  if (core.rank == 0) return {};
  core.jacobian();
  spectrum_.compute(core.rows.J, core.scales.rows, core.scales.columns);
  spectrum_.vectors(u_, v_);
  const double least = v_.norm(), mean = spectrum_.mean();
  core.jacobian_rate(system.velocity);
  v_.array() *= core.scales.columns.array();
  u_.array() *= core.scales.rows.array();
  double rate = 0.0;
  for (Eigen::Index i = 0; i < u_.size(); ++i)
    for (int j : core.rows.pattern[i]) rate += u_(i) * core.rows.J_dot(i, j) * v_(j);
  return {least / mean, rate / std::max(least, 1e-300) / mean};
}

bool RankMonitor::ahead(const Rank& end, double length) {
  return end.rate < 0.0 && end.value <= -steps_ahead * length * end.rate;
}

double RankMonitor::part(const Rank& before, const Rank& after, double h) {
  if (before.rate < 0.0 && after.rate > 0.0) {  // a V: where the tangents at both ends meet
    const double place = (after.value - before.value - after.rate * h) / (before.rate - after.rate);
    return before.value + before.rate * place < deep * std::max(before.value, after.value) ? std::nan("") : 1.0;
  }
  // falling, zero, a peak, and falling again; or a peak, zero, and rising again
  const bool over = before.rate < 0.0 ? h > jump * before.value / -before.rate
                                      : after.rate > 0.0 && h * after.rate > after.value;
  return over && h > shortest ? 0.5 : 1.0;
}

double RankMonitor::part(const Rank& before, const Rank& after, double h, double least) {
  return least < neck * std::max(before.value, after.value) && h > shortest ? 0.25 : 1.0;
}

}  // namespace ckc
