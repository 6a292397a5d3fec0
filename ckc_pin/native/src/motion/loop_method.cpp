// Choice of the integration method in the step loop.
#include <algorithm>

#include "motion/loop.hpp"
#include "motion/stiffness.hpp"

namespace ckc {

constexpr long first_stiffness_check = 50;  // steps before the first check of stiffness; doubled after each check
constexpr double max_rk45_steps = 2.0;      // RK45 integrates segments of at most this many of its steps

void StepLoop::use_method(Method& method) {
  if (method_ == &method) return;
  method_ = &method;
  method_->reset_history();
}

void StepLoop::use_implicit_method() {
  radau_ = std::make_unique<Radau>(*system, now, work, tolerance_);
  use_method(*radau_);
}

Explicit::Attempt StepLoop::prepare_explicit_step() {
  if (!method_ || method_ == radau_.get() || !(now.t < segment_end_)) return {};
  const bool is_prepared = joint_modes_known_ && state_is_accepted_;
  if (!is_prepared && prepare_step(segment_end_)) return {};
  return {method_ == &dop853_ ? &dop853_ : &rk45_, segment_end_, rate_is_known_,
          can_take_computed_end() ? &computed_end_ : nullptr};
}

// "auto" chooses the implicit method if damping or a controller makes the motion stiff.
void StepLoop::choose_method(double bound) {
  const bool may_be_stiff = options_.method == "auto" && (control->is_feedback() || system->core.springs.has_damping ||
                                                          system->core.joints.has_smooth_friction());
  if (options_.method == "Radau" || (may_be_stiff && motion_is_stiff(bound))) {
    use_implicit_method();
  } else {
    use_method(options_.method == "RK45" ? rk45_ : dop853_);
    next_stiffness_check_ = may_be_stiff ? first_stiffness_check : 0;
  }
  if (now.h == 0.0) now.h = method_->initial_step_size(bound, method_->error_order());
}

void StepLoop::choose_explicit_method(double bound) {
  if (!method_ || method_ == radau_.get() || options_.method != "auto") return;
  const double reach = method_ == &rk45_ ? rk45_.order_five_step_size() : dop853_.order_five_step_size();
  Explicit& best = bound - now.t <= max_rk45_steps * reach ? rk45_ : dop853_;
  if (&best == method_) return;
  use_method(best);
  now.h = &best == &rk45_ ? reach : std::max(now.h, max_rk45_steps * reach);
}

// Expected duration of the present segment: until the bound, or the mean of the previous segments between joint
// transitions, but at least the time since the last one.
// Breakpoints hardly excite decayed modes, so they do not end a segment.
double StepLoop::segment_duration(double bound) const {
  const double remaining = (control->sampling ? bound : std::max(bound, target_)) - now.t;
  return joint_segments_ ? std::min(remaining, std::max((now.t - start_.t) / static_cast<double>(joint_segments_),
                                                        now.t - joint_modes_time_))
                         : remaining;
}

// Consider the present segment only: a joint transition excites modes that had decayed, and they must be resolved
// again.
bool StepLoop::motion_is_stiff(double bound) {
  if (!system->core.d) return false;  // only prescribed joints move
  Matrix jacobian;
  ++work.jacobians;
  if (!system->jacobian(now.t, now.y, jacobian, work.rhs)) return false;
  jacobian.conservativeResize(system->motion_size, system->motion_size);
  return system->reduce_to_freedoms(now.y, jacobian) && is_stiff(jacobian, segment_duration(bound));
}

// A motion may become stiff after its start.
std::optional<Stop> StepLoop::check_stiffness(double bound) {
  if (!next_stiffness_check_ || ++accepted_steps_ < next_stiffness_check_) return {};
  next_stiffness_check_ *= 2;
  if (const auto stop = prepare_step(bound)) return stop;
  if (now.t < bound && motion_is_stiff(bound)) next_stiffness_check_ = 0, use_implicit_method();
  return {};
}

}  // namespace ckc
