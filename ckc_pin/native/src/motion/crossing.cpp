#include "motion/crossing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace ckc {

// Relative to the time until a crossing: how far past the end of the run it may be, how far from the middle of the step
// it may be, and the tolerance of Newton's method for its expected time.
constexpr double max_time_past_end = 0.3, max_centre_error = 0.04, newton_time_tolerance = 0.01;
// Singular value at an expected crossing, relative to the present one, above which it is no crossing.
constexpr double max_remaining_singular_value = 0.01;
constexpr double look_ahead_steps = 4.0;  // number of steps within which crossings are expected
// Where a run that cannot cross a position ends, relative to the distance from which it was first seen, and the part of
// the distance that one step covers.
constexpr double end_of_approach = 0.1, approach_fraction = 0.9;
constexpr int max_attempts = 6, max_newton_steps = 10, manifold_checks = 9;
// Bits of accuracy in the search for the smallest singular value, ahead of the step and within it.
constexpr int ahead_search_bits = 8, step_search_bits = 24;
constexpr double rank_lost = RankMonitor::rank_lost, not_found = std::numeric_limits<double>::quiet_NaN();

Crossing::Crossing(System& system, Method*& method, Step& step, RankMonitor& monitor,
                   std::unique_ptr<Collocation> collocation_, double manifold_tolerance)
    : collocation(std::move(collocation_)),
      system_(system),
      method_(method),
      step_(step),
      monitor_(monitor),
      manifold_tolerance_(manifold_tolerance) {
  y_.setZero(system.size);
  reset();
}

void Crossing::reset() {
  crossing_in_rejected_step_ = not_found, max_distance_ = std::numeric_limits<double>::infinity(), attempts_ = 0;
  blocking_.reset();
}

bool Crossing::may_pass() const { return collocation && attempts_ < max_attempts; }

double Crossing::time_to_crossing(const Rank& end, double step_size, double t_bound) {
  const double t = step_.t, crossing = std::exchange(crossing_in_rejected_step_, not_found);
  if (std::isfinite(crossing)) return crossing - t;
  // Steps may become short before the position, where rates are inexact. The last crossing tells from how far a
  // crossing step succeeds.
  const double last_distance = std::isfinite(max_distance_) ? max_distance_ : 0.0;
  if (!may_pass() || !RankMonitor::may_lose_rank_within(end, std::max(look_ahead_steps * step_size, last_distance)))
    return not_found;
  Core& core = system_.core;
  const int nq = core.tree.nq;
  const auto extrapolate = [&](double at) {  // with constant acceleration
    const double h = at - t;
    y_ = step_.y + h * step_.f;
    if (nq == core.n) y_.head(nq) += (0.5 * h * h) * step_.f.segment(nq, core.n);
  };
  const auto set_extrapolated = [&](double at) { return extrapolate(at), system_.set_core_configuration(y_); };
  const double linear_time = end.value / -end.rate, from = t + 0.3 * linear_time, to = t + 1.3 * linear_time;
  RankMonitor::Minimum minimum{find_zero(extrapolate, t + linear_time, newton_time_tolerance * linear_time), 0.0};
  if (!(minimum.t > from && minimum.t < to))
    minimum = monitor_.find_minimum(core, set_extrapolated, from, to, ahead_search_bits);
  return minimum.value >= max_remaining_singular_value * end.value ||
                 minimum.t - t_bound > max_time_past_end * (minimum.t - t)
             ? not_found
             : minimum.t - t;
}

Crossing::Verdict Crossing::judge_step(const Rank& end, const Rank& after) {
  const double h = step_.t_new - step_.t, fraction = RankMonitor::step_fraction(end, after, h);
  if (std::isnan(fraction)) {
    const auto set_interpolated = [&](double at) {
      return method_->interpolate(at, y_) && (system_.set_core_configuration(y_) || system_.sync_core(at, y_));
    };
    const RankMonitor::Minimum minimum =
        monitor_.find_minimum(system_.core, set_interpolated, step_.t, step_.t_new, step_search_bits);
    if (minimum.value < rank_lost) {
      if (!may_pass()) return approach(minimum.t, minimum.value);
      crossing_in_rejected_step_ = minimum.t;
      return {0.5 * (minimum.t - step_.t) / h};
    }
    const double resolved_fraction = RankMonitor::step_fraction(end, after, h, minimum.value);
    if (resolved_fraction < 1.0 || RankMonitor::has_rank(after)) return {resolved_fraction};
  }
  if (!RankMonitor::has_rank(after) && !(fraction < 1.0)) {
    if (!may_pass()) return approach(step_.t_new, after.value);
    crossing_in_rejected_step_ = step_.t_new;
    return {0.5};
  }
  return {std::isnan(fraction) ? 1.0 : fraction};
}

// Shorten the step so that it ends before a position that cannot be passed, or end the run if that is near.
Crossing::Verdict Crossing::approach(double t, double value) {
  const double distance = t - step_.t,
               closest_approach = blocking_ ? blocking_->closest_approach : end_of_approach * distance;
  blocking_ = {t, value, closest_approach};
  if (distance <= closest_approach) return {0.0, true, t, value};
  return {approach_fraction * distance / (step_.t_new - step_.t)};
}

double Crossing::step_over(double time_left, double step_size) {
  double crossed_at = not_found;
  if (time_left <= std::max(max_distance_, step_size)) {
    const double crossing = step_.t + time_left;
    ++attempts_;
    if (time_left < 0.5 * step_size)  // J is ill-conditioned here, so try from the start of the last step
      crossed_at = step_from(step_.t_old, step_.y_old, crossing);
    if (!std::isfinite(crossed_at)) crossed_at = step_from(step_.t, step_.y, crossing);
  }
  if (std::isfinite(crossed_at)) {
    attempts_ = 0;
  } else {  // let the next step end where a crossing step may succeed
    const double step_size = std::max(time_left - 0.9 * max_distance_, 0.1 * time_left);
    if (step_.h > step_size) method_->reset_history(), step_.h = step_size;
  }
  return crossed_at;
}

// Step from (t, y) with the crossing in the middle. Return the exact time of the crossing, NaN if the step fails.
double Crossing::step_from(double t, In y, double crossing) {
  for (int k = 0; k < 2; ++k) {
    const double remaining = crossing - t;
    collocation->make_step(t, y, 2 * remaining, k > 0);
    max_distance_ = remaining * std::clamp(collocation->step_scale(), 0.25, 2.0);
    if (!collocation->is_accurate()) break;
    const double crossed_at = find_zero([&](double at) { collocation->evaluate(at, y_); }, crossing, 0.0),
                 middle = (crossed_at - t) / remaining;
    if (!(middle > 0.5 && middle < 1.5) || !is_on_manifold()) break;
    if (std::abs(crossed_at - crossing) < max_centre_error * remaining) return crossed_at;
    crossing = crossed_at;
  }
  return not_found;
}

// Newton's method. The signed singular value is smooth at the crossing, so value / rate is the remaining time on both
// sides.
template <class Motion>
double Crossing::find_zero(const Motion& motion, double t, double accuracy) {
  double value = std::numeric_limits<double>::infinity();
  for (int k = 0; k < max_newton_steps; ++k) {
    motion(t);
    if (!y_.allFinite() || !system_.sync_core_at_last_rhs(t, y_)) return not_found;
    const double previous_value = value;
    const Rank rank = monitor_.evaluate(system_);
    value = rank.value;
    if (value <= 1e-3 * rank_lost) return t;
    if (!(value < 0.5 * previous_value) || rank.rate == 0.0) break;
    const double step = value / rank.rate;
    t -= step;
    if (std::abs(step) <= accuracy) return t;
  }
  return value <= rank_lost ? t : not_found;
}

// Whether the step stays on the constraint manifold. Otherwise it may have jumped over a narrow gap between branches.
bool Crossing::is_on_manifold() {
  for (int k = 0; k < manifold_checks; ++k) {
    const double t = collocation->t_old + (collocation->t - collocation->t_old) * k / (manifold_checks - 1);
    collocation->evaluate(t, y_);
    if (!system_.set_time(t) || !system_.set_core_configuration(y_) ||
        system_.core.constraints.phi.lpNorm<Eigen::Infinity>() > manifold_tolerance_)
      return false;
  }
  return true;
}

}  // namespace ckc
