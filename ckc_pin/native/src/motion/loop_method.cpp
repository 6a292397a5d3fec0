// Which method makes the steps.
#include <algorithm>

#include "motion/loop.hpp"
#include "motion/stiffness.hpp"

namespace ckc {

constexpr long first_check = 50;   // steps after which stiffness is looked at again, then twice as many
constexpr double few_steps = 2.0;  // of RK45: a segment that takes no more is its

void Loop::take(Method& method) {
  if (method_ == &method) return;
  method_ = &method;
  method_->forget();
}

void Loop::take_implicit() {
  radau_ = std::make_unique<Radau>(*system, now, work, tolerance_);
  take(*radau_);
}

// "auto": implicit where damping or a controller makes the motion stiff.
void Loop::choose(double bound) {
  const bool may_be_stiff = options_.method == "auto" && (control->feedback() || system->core.springs.any_damping || system->core.joints.smooth());
  if (options_.method == "Radau" || (may_be_stiff && is_stiff(bound))) {
    take_implicit();
  } else {
    take(options_.method == "RK45" ? rk45_ : dop853_);
    check_at_ = may_be_stiff ? first_check : 0;
  }
  if (now.h == 0.0) now.h = method_->first_length(bound, method_->error_order());
}

void Loop::choose_again(double bound) {
  if (!method_ || method_ == radau_.get() || options_.method != "auto") return;
  const double reach = method_ == &rk45_ ? rk45_.reach_of_order_five() : dop853_.reach_of_order_five();
  Explicit& best = bound - now.t <= few_steps * reach ? rk45_ : dop853_;
  if (&best == method_) return;
  take(best);
  now.h = &best == &rk45_ ? reach : std::max(now.h, few_steps * reach);
}

// Until joints change next: as long as on average so far, and no less than it has lasted already.
double Loop::lasts(double bound) const {
  const double left = bound - now.t;
  return restarts_ ? std::min(left, std::max((now.t - begin_.t) / static_cast<double>(restarts_), now.t - joints_at_)) : left;
}

// Within the motion's present piece: where joints change, a mode that had died out is excited anew, and has to be resolved.
bool Loop::is_stiff(double bound) {
  Matrix jacobian;
  ++work.jacobians;
  return system->jacobian(now.t, now.y, jacobian, work.rhs) && system->modes(now.y, jacobian) &&
         stiff(jacobian, lasts(bound));
}

// After a while, and then after twice as long: what was not stiff at the start may have become so.
std::optional<Stop> Loop::check_stiffness(double bound) {
  if (!check_at_ || ++kept_ < check_at_) return {};
  check_at_ *= 2;
  if (const auto stop = begin(bound)) return stop;
  if (now.t < bound && is_stiff(bound)) check_at_ = 0, take_implicit();
  return {};
}

}  // namespace ckc
