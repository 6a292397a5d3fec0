// Transitions of joint modes in the step loop.
#include <algorithm>
#include <cmath>

#include "motion/loop.hpp"

namespace ckc {

// Accuracy of an event's time: in s, and relative to the last step size.
constexpr double event_time_tolerance = 4e-12, relative_event_time_tolerance = 1e-9;
constexpr long max_transitions_at_instant = 200;
// After this many transitions at one instant, the rounding tolerance of forces grows step by step, up to 1e-6 of the
// forces. Joints then stay locked.
constexpr long transitions_before_growth = 10, max_growth_steps = 12;
constexpr double rounding_growth = 4.0;
// Rate above which a joint that was blocked by the loops has started to move, relative to the fastest coordinate.
constexpr double max_relative_immobile_rate = 1e-9;
// Distance beyond a stop at which its event was missed; rad, or relative to the mechanism's size.
constexpr double stop_passed_tolerance = 1e-7;
constexpr double max_flight_ratio = 1.5;  // largest first step after an impact, relative to the duration of the bounce

void StepLoop::reset_joints() {
  system->core.joints.reset();
  joint_transitions_.reset();
  joint_modes_known_ = !system->core.joints.has_events(), transitions_at_instant_ = joint_segments_ = 0;
}

std::optional<Stop> StepLoop::update_joint_modes() {
  const double time_tolerance = event_time_tolerance + relative_event_time_tolerance * std::max(now.t - now.t_old, 0.0);
  transitions_at_instant_ = std::abs(now.t - joint_modes_time_) <= time_tolerance ? transitions_at_instant_ + 1 : 0;
  if (!transitions_at_instant_ && now.t > start_.t) ++joint_segments_;
  joint_modes_time_ = now.t;
  if (!is_repeating_ && !events.determine_signs_before_transition(now.t, now.y)) return event_failure();
  if (transitions_at_instant_ > max_transitions_at_instant) return Stop{Stop::chatter, now.t};
  system->core.joints.rounding_factor = std::pow(
      rounding_growth, std::clamp<long>(transitions_at_instant_ - transitions_before_growth, 0, max_growth_steps));
  if (!joint_transitions_.update(now.t, now.y, events.joint_events, time_tolerance)) {
    const Stop stop = step_failure();
    return stop.reason == Stop::step && system->failure == RhsFailure::none ? Stop{Stop::contact_unsolved, now.t}
                                                                            : stop;
  }
  events.monitor_joints(joint_transitions_.coordinates, system->velocity, time_tolerance);
  joint_modes_known_ = true, state_is_accepted_ = rate_is_known_ = false;
  // A step much longer than the next bounce would miss it.
  now.h = std::min(transitions_at_instant_ ? now.h / 4 : now.h,
                   max_flight_ratio * joint_transitions_.first_bounce_duration);
  return {};
}

std::optional<Stop> StepLoop::check_joints() {
  Joints& joints = system->core.joints;
  if (!joints.locked.empty()) {
    bool changed;
    if (!system->sync_core(now.t, now.y) ||
        !system->correct_locked_joints(now.y, options_.manifold_tolerance / 10, changed))
      return step_failure();
    if (changed) rate_is_known_ = false;
    if (integrand && !integrand->stays_locked(tolerance_.atol)) return step_failure();
  }
  const int beyond =
      joints.find_joint_beyond_stop(system->core.q_tree, system->core.tree.q_index, stop_passed_tolerance);
  if (beyond >= 0) return Stop{Stop::beyond_stop, now.t, 0.0, beyond};
  const double rate_tolerance = max_relative_immobile_rate * system->velocity.lpNorm<Eigen::Infinity>();
  for (int k : joints.immobile)
    if (std::abs(system->velocity(k)) > rate_tolerance) return state_changed(), std::nullopt;
  return {};
}

}  // namespace ckc
