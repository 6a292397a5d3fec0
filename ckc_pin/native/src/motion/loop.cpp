#include "motion/loop.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

namespace ckc {

using Clock = std::chrono::steady_clock;

// Upper bound of rtol in runs that cross singular positions. With larger values errors reach 1e-2 after ten seconds.
constexpr double crossing_rtol = 1e-7;
// Smallest step, relative to the remaining time, that is retried if its end or interior cannot be evaluated.
constexpr double min_retry_fraction = 1e-9;
// Lower bounces are within the closure tolerance; rad, or relative to the mechanism's size.
constexpr double min_bounce_rise = 1e-10;
constexpr double infinity = std::numeric_limits<double>::infinity();

static std::unique_ptr<Collocation> collocation_of(System& system, Work& work, const Tolerance& tolerance) {
  return system.crosses_singularities ? std::make_unique<Collocation>(system, work, tolerance) : nullptr;
}

// Return the system with the integrand appended. Members that are constructed later need its full size.
static std::unique_ptr<System> with_integrand(std::unique_ptr<System> system, Integrand* integrand) {
  if (integrand) system->append(*integrand);
  return system;
}

StepLoop::StepLoop(std::unique_ptr<Control> control_, std::unique_ptr<System> system_,
                   std::unique_ptr<Integrand> integrand_, Options options, std::vector<Event> list)
    : control(std::move(control_)),
      system(with_integrand(std::move(system_), integrand_.get())),
      integrand(std::move(integrand_)),
      recorder(*system),
      events(*system, now, std::move(list)),
      options_(std::move(options)),
      tolerance_{options_.rtol, options_.atol, options_.max_step},
      dop853_(Explicit::dop853, *system, now, work, tolerance_),
      rk45_(Explicit::rk45, *system, now, work, tolerance_),
      monitor_(system->core),
      energy_(system->core),
      crossing_(*system, method_, now, monitor_, collocation_of(*system, work, tolerance_), options_.manifold_tolerance),
      joint_transitions_(*system, std::max(options_.atol, min_bounce_rise), tolerance_) {
  for (Vector* x : {&now.y, &now.f, &now.y_new, &now.f_new, &now.y_old, &y_out_, &y_present_}) x->setZero(system->size);
}

void StepLoop::start(double t, In q_tree, In v_tree, In w) {
  tolerance_.rtol = options_.rtol, tolerance_.atol = options_.atol;
  start_ = {t, q_tree, v_tree, w};
  work = {}, work.max_rhs = options_.max_rhs;
  system->counts = {}, system->failure = RhsFailure::none;
  control->failure = {};
  control->start(t);
  if (system->forces()) system->forces()->reset();
  system->start_prescribed_joints(q_tree, v_tree);
  system->start_segment(t);
  reset_joints();
  start_state();
  now.t_old = now.t, now.y_old = now.y, now.h = 0.0;
  steps = {}, crossings.clear(), accepted_steps_ = 0, next_stiffness_check_ = 0, last_step_size_ = 0.0, pace_rhs_ = 0,
  pace_time_ = t;
  method_ = nullptr, radau_.reset(), segment_end_ = t;
  state_is_accepted_ = rate_is_known_ = cannot_repeat_ = false;
  waiting_step_.reset(), advances_unchanged_ = 0, is_paused_ = false;
  crossing_.reset(), monitor_.reset();
  computed_end_.t = std::nan("");
  events.reset();
}

void StepLoop::start_state() {
  system->start(start_.t, start_.q_tree, start_.v_tree, start_.w, now.y);
  system->start_appended(now.y);
  if (integrand) integrand->start(start_.q_tree, start_.v_tree, now.y);
  now.t = start_.t;
}

void StepLoop::state_changed() {
  return_to_present();
  advances_unchanged_ = 0, is_paused_ = false;
  rate_is_known_ = false, cannot_repeat_ = true;
  joint_modes_known_ = !system->core.joints.has_events();
  if (method_) method_->reset_history();
}

void StepLoop::set_control(In u, bool of_motors) {
  if (control->set_constant(u, of_motors)) state_changed();
}

bool StepLoop::set_wrench(size_t force, In wrench) {
  if (!system->forces()->set(force, wrench)) return false;
  return state_changed(), true;
}

bool StepLoop::move_desired(double end, In x) {
  if (!control->law || !control->law->move_desired(t(), end, x)) return false;
  return state_changed(), true;
}

Stop StepLoop::advance(double until, bool final, double pause, double budget) {
  const bool is_timed = pause >= 0.0 || std::isfinite(budget);
  const auto started = is_timed ? Clock::now() : Clock::time_point();
  const auto elapsed = [&] {
    return is_timed ? std::chrono::duration<double>(Clock::now() - started).count() : 0.0;
  };
  system->may_change_partition = !control->needs_fixed_partition();
  const bool continues = std::exchange(is_paused_, false) && until == target_;
  const double from = t();
  if (!continues) target_ = until, ++advances_unchanged_;
  if (waiting_step_) {
    if (until < now.t_new) return report_present(until);
    const CompletedStep step = *waiting_step_;
    waiting_step_.reset();
    if (const auto stop = finish_step(step, now.t_new, false)) return *stop;
  }
  if (control->needs_fixed_partition()) {
    bool changed = false;
    if (!system->restore_partition(now.t, now.y, changed))
      return {Stop::coordinates_singular, now.t, system->coordinate_margin()};
    if (changed) state_is_accepted_ = false, state_changed();
  }
  may_step_beyond_ = !final && !control->law && !std::isfinite(system->next_breakpoint()) && events.is_empty();
  // Reach as far beyond as the last calls advanced without a change. `advances_unchanged_` is zero if the partition was
  // just restored.
  if (!continues)
    reach_beyond_ = may_step_beyond_ && advances_unchanged_ > 0
                        ? static_cast<double>(advances_unchanged_ - 1) * (until - from)
                        : 0.0;
  for (;;) {
    if (system->next_breakpoint() <= now.t + system->breakpoint_tolerance()) {
      if (!system->switch_prescribed_joints(now.t, now.y, {})) return step_failure();
      system->start_segment(now.t), state_changed();
    }
    const bool is_sampled = control->sampling.has_value();
    const double time_tolerance =
        std::max(is_sampled ? control->sampling->time_tolerance(now.t) : 0.0, system->breakpoint_tolerance());
    if (is_sampled && control->sampling->next_instant() <= now.t + time_tolerance)
      if (const auto stop = sample_control()) return *stop;
    const double next_instant =
        std::min(is_sampled ? control->sampling->next_instant() : infinity, system->next_breakpoint());
    record_until_ = std::isfinite(next_instant) || is_sampled ? std::min(until, next_instant) - time_tolerance : until;
    while (recorder.is_due(now.t + time_tolerance)) {
      if (!recorder.add(*system, recorder.next_instant(), now.y)) return output_failure();
      recorder.advance_instant();
    }
    if (!(now.t < until)) return {Stop::end, now.t};
    const double bound = next_instant < until - time_tolerance ? next_instant : until;
    if (bound + reach_beyond_ != segment_end_)
      choose_explicit_method(bound + reach_beyond_), segment_end_ = bound + reach_beyond_;
    const bool is_start = !method_;
    if (const auto stop = prepare_step(bound + reach_beyond_)) return *stop;
    if (is_start && pause < 0.0) return is_paused_ = true, Stop{Stop::pause, now.t};
    while (now.t < bound) {
      const double t_before = now.t;
      if (const auto stop = make_step(bound + reach_beyond_, final && bound == until)) {
        if (reach_beyond_ == 0.0 || now.t != t_before || stop->reason == Stop::rhs_budget) return *stop;
        reach_beyond_ = 0.0, now.h = std::min(now.h, bound - now.t);  // the cause of the stop may lie beyond `bound`
        continue;
      }
      if (waiting_step_) return report_present(until);
      if (const auto stop = check_pace(until)) return *stop;
      if (system->next_breakpoint() < bound) break;  // a prescribed motion has begun
      const double seconds = elapsed();
      if (seconds > budget) return {Stop::wall_budget, now.t};
      if (seconds > pause || work.rhs >= pause_at) return is_paused_ = true, Stop{Stop::pause, now.t};
    }
  }
}

// Without a budget, stop runs that would take hours, such as a motion that rotates ever faster.
std::optional<Stop> StepLoop::check_pace(double until) {
  constexpr long min_rhs = 1'000'000;
  constexpr double max_remaining_rhs = 1e9;
  const long rhs_done = work.rhs - pace_rhs_;
  if (options_.max_rhs < unlimited || rhs_done < min_rhs) return std::nullopt;
  const double remaining_rhs = static_cast<double>(rhs_done) * (until - now.t) / (now.t - pace_time_);
  if (!(remaining_rhs <= max_remaining_rhs)) return Stop{Stop::pace, now.t, remaining_rhs};
  pace_rhs_ = work.rhs, pace_time_ = now.t;
  return std::nullopt;
}

Stop StepLoop::report_present(double until) {
  if (!waiting_step_->motion->interpolate(until, y_out_)) return output_failure();
  t_present_ = until, y_present_ = y_out_;
  return {Stop::end, until};
}

void StepLoop::return_to_present() {
  if (!waiting_step_) return;
  now.t_old = now.t, now.y_old = now.y;
  now.t = t_present_, now.y = y_present_;
  now.h = std::min(now.h, now.t_new - now.t_old);
  waiting_step_.reset(), state_is_accepted_ = false;
}

// Sample the state, then apply the outputs whose delay has elapsed.
std::optional<Stop> StepLoop::sample_control() {
  if (!system->sync_core(now.t, now.y)) return step_failure();
  system->core.set_velocity(system->v_tree);
  bool changed;
  if (!control->sample(system->measured(now.t), changed) || (integrand && !integrand->control_sampled(now.y, changed)))
    return step_failure();
  if (changed) state_changed();
  return {};
}

// Evaluate the derivative, events and rank monitor at the start of a step.
std::optional<Stop> StepLoop::prepare_step(double bound) {
  if (!joint_modes_known_)
    if (const auto stop = update_joint_modes()) return stop;
  const bool is_new = !state_is_accepted_;
  if (is_new) {
    if (!system->sync_core_at_start(now.t, now.y)) return step_failure();
    end_rank_ = monitor_.evaluate(*system);
    energy_.start_step(*system);
    const Accepted accepted = accept_state(now.t, now.y, system->coordinate_margin());
    if (accepted == Accepted::rejected) return Stop{Stop::coordinates_singular, now.t, system->coordinate_margin()};
    if (accepted != Accepted::unchanged) rate_is_known_ = false;
    state_is_accepted_ = true;
  }
  if (!rate_is_known_) {
    rate_is_known_ = (method_ ? *method_ : dop853_).evaluate_start();
    if (!rate_is_known_) return step_failure();
    events.start_step();
    if (!method_) choose_method(bound);
  }
  return {};
}

// Whether a run may stop so shortly before a position where J loses rank: the equations are ill-conditioned there.
static bool may_follow_from_rank_loss(Stop::Reason reason) {
  return reason == Stop::coordinates_singular || reason == Stop::step || reason == Stop::min_step ||
         reason == Stop::energy;
}

std::optional<Stop> StepLoop::make_step(double bound, bool last) {
  if (const auto stop = prepare_step(bound)) return stop;
  if (system->core.rank && !method_->is_repeating()) {
    const double remaining =
        crossing_.time_to_crossing(end_rank_, last_step_size_, may_step_beyond_ ? infinity : bound);
    if (std::isfinite(remaining)) {
      const double crossed_at = crossing_.step_over(remaining, last_step_size_);
      if (work.budget_exhausted || control->failure.raised) return step_failure();
      if (std::isfinite(crossed_at)) {
        if (tolerance_.rtol > crossing_rtol) {
          tolerance_.rtol = crossing_rtol, tolerance_.atol = std::min(tolerance_.atol, crossing_rtol / 100);
          if (!cannot_repeat_ && now.t > start_.t) {
            if (const auto stop = repeat_with_finer_tolerance()) return stop;
            crossing_.expect_at(crossed_at);
            return {};
          }
        }
        return make_crossing_step(crossed_at, remaining, bound, last);
      }
    }
  }
  auto stop = make_ordinary_step(bound, last);
  if (stop && crossing_.blocking() && may_follow_from_rank_loss(stop->reason))
    stop = Stop{Stop::rank, crossing_.blocking()->t, crossing_.blocking()->value};
  return stop;
}

std::optional<Stop> StepLoop::make_ordinary_step(double bound, bool last) {
  if (!method_->make_step(bound)) return method_->is_repeating() ? std::nullopt : std::optional(step_failure());
  system->failure = RhsFailure::none;
  if (!control->failure.message.empty() || control->failure.u.size()) control->failure = {};
  const double h = now.t_new - now.t;
  if (h < options_.min_step && now.t_new < bound) return Stop{Stop::min_step, now.t};
  const auto retry_with = [&](double part) { return method_->reject_step(part * h), std::nullopt; };
  const bool can_retry = h > min_retry_fraction * (bound - now.t);
  const bool end_is_computed = std::exchange(computed_end_.t, std::nan("")) == now.t &&
                               computed_end_.t_new == now.t_new && energy_.is_kept(computed_end_);
  CompletedStep step{method_, std::nan(""), computed_end_.rank, infinity, end_is_computed};
  if (!end_is_computed) {
    if (!system->sync_core_at_last_rhs(now.t_new, now.y_new))
      return can_retry ? retry_with(0.5) : std::optional(step_failure());
    if (!energy_.is_kept(*system, tolerance_.rtol, tolerance_.atol)) {
      if (can_retry) return retry_with(0.5);
      return Stop{Stop::energy, now.t, energy_.change};
    }
    events.end_step();
    step.after = monitor_.evaluate(*system), step.margin = system->coordinate_margin();
  }
  if (system->core.rank) {
    const Crossing::Verdict verdict = crossing_.judge_step(end_rank_, step.after);
    if (control->failure.raised || work.budget_exhausted) return step_failure();
    if (verdict.rank_lost) {
      method_->interpolate(verdict.t, y_out_);
      system->sync_core(verdict.t, y_out_);
      return Stop{Stop::rank, verdict.t, verdict.value};
    }
    if (verdict.fraction < 1.0) return retry_with(verdict.fraction);
  }
  return submit_step(step, bound, last);
}

std::optional<Stop> StepLoop::submit_step(const CompletedStep& step, double bound, bool last) {
  if (!(now.t_new > target_)) return finish_step(step, bound, last);
  waiting_step_ = step;
  return {};
}

std::optional<Stop> StepLoop::finish_step(const CompletedStep& step, double bound, bool last) {
  const double h = now.t_new - now.t;
  const bool is_ordinary = std::isnan(step.crossed_at);
  if (const auto stop = accept_step(step, last)) {
    if (!is_ordinary || stop->reason != Stop::output || !(h > min_retry_fraction * (bound - now.t))) return stop;
    return method_->reject_step(0.5 * h), std::nullopt;
  }
  ++steps[method_index()];
  if (is_ordinary) return last_step_size_ = h, state_is_accepted_ ? check_stiffness(bound) : std::nullopt;
  method_->reset_history();
  crossings.push_back(step.crossed_at);
  return {};
}

// Cross a singular position with the collocation step that was just found.
std::optional<Stop> StepLoop::make_crossing_step(double crossed_at, double remaining, double bound, bool last) {
  Collocation& motion = *crossing_.collocation;
  now.t_new = may_step_beyond_ ? motion.t : std::min(motion.t, bound),
  now.h_next = last_step_size_ > 0.0 ? last_step_size_ : remaining;
  motion.evaluate(now.t_new, now.y_new);
  if (!system->sync_core(now.t_new, now.y_new)) return step_failure();
  energy_.start_step(*system);
  const RankMonitor::Rank after = monitor_.evaluate(*system);
  events.restart();
  const bool is_end = last && now.t_new == bound;  // a run may end at a singular position
  if (!is_end && !RankMonitor::has_rank(after)) return Stop{Stop::rank, now.t_new, after.value};
  if (!is_end && !method_->evaluate(now.t_new, now.y_new, now.f_new)) return step_failure();
  if (!is_end) events.end_step();
  return submit_step({&motion, crossed_at, after, system->coordinate_margin()}, bound, last);
}

bool StepLoop::can_take_computed_end() const {
  return events.is_empty() && !integrand && !system->core.joints.has_events() && !may_step_beyond_ &&
         RankMonitor::has_two_rows(system->core) && system->projection_tolerance() > 0.0;
}

Accepted StepLoop::accept_computed_end() {
  now.y_new = computed_end_.y;
  system->counts.newton += computed_end_.newton_steps, system->counts.factorizations += 2 * computed_end_.newton_steps;
  system->elimination.accept_step(system->core);
  return computed_end_.is_projected ? Accepted::changed : Accepted::unchanged;
}

Accepted StepLoop::accept_state(double t, Out y, double margin) {
  if (integrand) integrand->accept_step(y);
  return system->accept_step(t, y, margin);
}

// Find events and record outputs in a completed step, then make its end the present state.
std::optional<Stop> StepLoop::accept_step(const CompletedStep& step, bool last) {
  if (!is_repeating_ || system->core.joints.has_events()) {
    Interpolant& motion = *step.motion;
    double stop_time;
    if (const auto stop = find_events(motion, last, stop_time)) return stop;
    if (!is_repeating_)
      if (const auto stop = record_outputs(motion, std::min(now.t_new, stop_time))) return stop;
    if (std::isfinite(stop_time)) {
      if (stop_time < now.t_new && !motion.interpolate(stop_time, y_out_)) return output_failure();
      now.t_old = now.t, now.y_old = now.y;
      now.y = stop_time < now.t_new ? y_out_ : now.y_new, now.t = stop_time;
      state_is_accepted_ = false;
      state_changed(), events.restart();
      if (!events.switching.empty()) {
        if (!system->switch_prescribed_joints(now.t, now.y, events.switching)) return step_failure();
        system->start_segment(now.t);
      }
      if (!events.stopped()) return {};  // only joint modes change
      // The state before an impact may have been recorded.
      if (system->core.joints.has_events() && now.t == now.t_old) recorder.drop_row_at(now.t);
      if (!record_now()) return step_failure();
      return Stop{Stop::event, now.t};
    }
  }
  const Accepted accepted =
      step.end_is_computed ? accept_computed_end() : accept_state(now.t_new, now.y_new, step.margin);
  method_->accept_step();
  crossing_.accept_step(step.after);
  end_rank_ = step.after, energy_.accept_step();
  rate_is_known_ = accepted == Accepted::unchanged;
  if (accepted == Accepted::rejected) return Stop{Stop::coordinates_singular, now.t, step.margin};
  if (accepted == Accepted::restarted) method_->reset_history();
  return system->core.joints.has_events() ? check_joints() : std::nullopt;
}

std::optional<Stop> StepLoop::find_events(Interpolant& motion, bool last, double& stop_time) {
  if (events.find_events(motion, last, is_repeating_, stop_time)) return {};
  return event_failure();
}

// Reason why an event's function has no value.
Stop StepLoop::event_failure() {
  if (events.failed >= 0) return Stop{Stop::event_function, now.t, events.failed_value, events.failed};
  return output_failure();
}

std::optional<Stop> StepLoop::record_outputs(Interpolant& motion, double until) {
  for (until = std::min(until, record_until_); recorder.is_due(until); recorder.advance_instant()) {
    const double t = recorder.next_instant();
    if (t == now.t_new)
      y_out_ = now.y_new;
    else if (!motion.interpolate(t, y_out_))
      return output_failure();
    if (!recorder.add(*system, t, y_out_)) return output_failure();
  }
  return {};
}

// Reason why a state within a step cannot be evaluated.
Stop StepLoop::output_failure() {
  const Stop stop = step_failure();
  return stop.reason == Stop::step ? Stop{Stop::output, now.t} : stop;
}

bool StepLoop::record_now() { return recorder.add(*system, t(), y()); }

// Repeat the run up to the present time with a smaller tolerance.
std::optional<Stop> StepLoop::repeat_with_finer_tolerance() {
  const double until = now.t;
  reset_joints();
  start_state();
  now.t_old = now.t, now.h = (until - now.t) / 10;
  state_is_accepted_ = rate_is_known_ = false, last_step_size_ = 0.0;
  method_->reset_history();
  crossing_.reset();
  is_repeating_ = true, may_step_beyond_ = false;
  std::optional<Stop> stop;
  while (now.t < until && !stop) stop = make_step(until, false);
  is_repeating_ = false;
  if (!stop) stop = prepare_step(infinity);
  return stop;
}

// Reason why no step can be made.
Stop StepLoop::step_failure() {
  if (control->failure.raised) return {Stop::exception, now.t};
  if (work.budget_exhausted) return {Stop::rhs_budget, now.t};
  if (system->failure == RhsFailure::no_control || !control->failure.message.empty() || control->failure.u.size())
    return {Stop::control, now.t};
  return {Stop::step, now.t};
}

}  // namespace ckc
