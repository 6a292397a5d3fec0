// When it is decided anew which joints slide, stick and touch.
#include <algorithm>
#include <cmath>

#include "motion/loop.hpp"

namespace ckc {

constexpr double located = 4e-12, of_step = 1e-9;  // s, and of the last step: how closely an event's time is known
constexpr long most_changes = 200;  // of joints at one instant
// After so many changes at one instant, forces count as zero up to ever larger rounding errors, so that joints stay held:
// up to 1e-6 of the forces.
constexpr long impatient_changes = 10, patience_steps = 12;
constexpr double patience_growth = 4.0;
constexpr double stirs = 1e-9;      // of the fastest coordinate: an idle joint begins to move
constexpr double passed = 1e-7;       // rad, or of the mechanism's size: a stop was passed unseen
constexpr double longer = 1.5;      // times the bounce that follows: the step from there

void Loop::begin_joints() {
  system->core.joints.begin();
  joint_changes_.begin();
  joints_known_ = !system->core.joints.any(), joints_often_ = restarts_ = 0;
}

std::optional<Stop> Loop::change_joints() {
  const double within = located + of_step * std::max(now.t - now.t_old, 0.0);
  joints_often_ = std::abs(now.t - joints_at_) <= within ? joints_often_ + 1 : 0;
  if (!joints_often_ && now.t > begin_.t) ++restarts_;
  joints_at_ = now.t;
  if (!silent_ && !events.learn_signs_before_change(now.t, now.y)) return event_failure();
  if (joints_often_ > most_changes) return Stop{Stop::chatter, now.t};
  system->core.joints.patience =
      std::pow(patience_growth, std::clamp<long>(joints_often_ - impatient_changes, 0, patience_steps));
  if (!joint_changes_.decide(now.t, now.y, events.changing, within)) {
    const Stop stop = trouble();
    return stop.why == Stop::step && system->trouble == Trouble::none ? Stop{Stop::contact, now.t} : stop;
  }
  events.monitor_joints(joint_changes_.coordinates, system->velocity, within);
  joints_known_ = true, begun_ = f_known_ = false;
  // A step that is far longer than what happens next would not see that.
  now.h = std::min(joints_often_ ? now.h / 4 : now.h, longer * joint_changes_.flight);
  return {};
}

std::optional<Stop> Loop::keep_joints() {
  Joints& joints = system->core.joints;
  if (!joints.locked.empty()) {
    bool changed;
    if (!system->exact(now.t, now.y) || !system->keep_locked(now.y, options_.closed / 10, changed)) return trouble();
    if (changed) f_known_ = false;
    if (!system->stays_locked(tolerance_.atol)) return trouble();
  }
  const int beyond = joints.beyond_stop(system->core.q_tree, system->core.tree.place, passed);
  if (beyond >= 0) return Stop{Stop::beyond_stop, now.t, 0.0, beyond};
  const double moving = stirs * system->velocity.lpNorm<Eigen::Infinity>();
  for (int k : joints.idle)
    if (std::abs(system->velocity(k)) > moving) return jump(), std::nullopt;
  return {};
}

}  // namespace ckc
