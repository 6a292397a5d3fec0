#include "motion/loop.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

namespace ckc {

using Clock = std::chrono::steady_clock;

// At least, in a run that crosses losses of rank: with less they come out up to 1e-2 off after ten seconds.
constexpr double fine_rtol = 1e-7;
constexpr double shortest_known = 1e-9;  // of what is left: a step whose end, or inside, cannot be known is made again
constexpr double energy_change = 100.0;  // of a conservative motion in a step, in tolerances: a wrong step, not an error
constexpr double least_rise = 1e-10;  // rad, or of the mechanism's size, of a bounce: less is how closely loops close
constexpr double infinity = std::numeric_limits<double>::infinity();

static std::unique_ptr<Collocation> collocation_of(System& system, Work& work) {
  Dae* dae = dynamic_cast<Dae*>(&system);
  return dae && dae->crosses ? std::make_unique<Collocation>(*dae, work) : nullptr;
}

Loop::Loop(std::unique_ptr<Control> control_, std::unique_ptr<System> system_, Options options, std::vector<Event> list)
    : control(std::move(control_)),
      system(std::move(system_)),
      recorder(*system),
      events(*system, now, std::move(list)),
      options_(std::move(options)),
      tolerance_{options_.rtol, options_.atol, options_.max_step},
      dop853_(Explicit::dop853, *system, now, work, tolerance_),
      rk45_(Explicit::rk45, *system, now, work, tolerance_),
      monitor_(system->core),
      energy_(system->core),
      crossing_(*system, method_, now, monitor_, collocation_of(*system, work), options_.closed),
      joint_changes_(*system, std::max(options_.atol, least_rise), tolerance_) {
  for (Vector* x : {&now.y, &now.f, &now.y_new, &now.f_new, &now.y_old, &y_out_, &y_present_}) x->setZero(system->size);
}

void Loop::start(double t, In q_tree, In v_tree, In w) {
  tolerance_.rtol = options_.rtol, tolerance_.atol = options_.atol;
  begin_ = {t, q_tree, v_tree, w};
  work = {}, work.most_rhs = options_.max_rhs;
  system->counts = {}, system->trouble = Trouble::none;
  control->problem = {};
  control->begin();
  begin_joints();
  system->start(t, q_tree, v_tree, w, now.y);
  now.t = now.t_old = t, now.y_old = now.y, now.h = 0.0;
  steps = {}, crossings.clear(), kept_ = 0, check_at_ = 0, length_ = 0.0, paced_ = 0, paced_at_ = t;
  method_ = nullptr, radau_.reset(), segment_ = t;
  begun_ = f_known_ = jumped_ = false;
  beyond_.reset(), unchanged_ = 0;
  crossing_.begin();
  events.begin();
}

void Loop::jump() {
  back();
  unchanged_ = 0;
  f_known_ = false, jumped_ = true;
  joints_known_ = !system->core.joints.any();
  if (method_) method_->forget();
}

void Loop::hold(In u, bool of_motors) {
  if (control->hold(u, of_motors)) jump();
}

Stop Loop::advance(double until, bool final, double pause, double budget) {
  const auto started = Clock::now();
  const auto spent = [&] { return std::chrono::duration<double>(Clock::now() - started).count(); };
  system->may_switch = !control->needs_own_partition();
  const double from = t();
  until_ = until, ++unchanged_;
  if (beyond_) {
    if (until < now.t_new) return within(until);
    const Made step = *beyond_;
    beyond_.reset();
    if (const auto stop = finish(step, now.t_new, false)) return *stop;
  }
  if (control->needs_own_partition()) {
    bool changed = false;
    if (!system->own_partition(now.t, now.y, changed)) return {Stop::chart, now.t, system->margin()};
    if (changed) begun_ = false, jump();
  }
  reaches_ = !final && !control->law && !events.any();
  double ahead = reaches_ ? static_cast<double>(unchanged_ - 1) * (until - from) : 0.0;  // as far as nothing has changed for
  for (;;) {
    const double near = control->sampling ? control->sampling->near(now.t) : 0.0;
    if (control->sampling && control->sampling->instant() <= now.t + near)
      if (const auto stop = sample()) return *stop;
    last_instant_ = control->sampling ? std::min(until, control->sampling->instant()) - near : until;
    while (recorder.due(now.t + near)) {
      if (!recorder.add(*system, recorder.instant(), now.y)) return unknown();
      recorder.passed();
    }
    if (!(now.t < until)) return {Stop::end, now.t};
    double bound = until;
    if (control->sampling && control->sampling->instant() < until - near) bound = control->sampling->instant();
    if (bound + ahead != segment_) choose_again(bound + ahead), segment_ = bound + ahead;  // not where a pause has ended
    if (const auto stop = begin(bound + ahead)) return *stop;
    while (now.t < bound) {
      const double before = now.t;
      if (const auto stop = one_step(bound + ahead, final && bound == until)) {
        if (ahead == 0.0 || now.t != before || stop->why == Stop::rhs_budget) return *stop;
        ahead = 0.0, now.h = std::min(now.h, bound - now.t);  // what is in the way may lie beyond
        continue;
      }
      if (beyond_) return within(until);
      if (const auto stop = keep_pace(until)) return *stop;
      const double seconds = spent();
      if (seconds > budget) return {Stop::wall_budget, now.t};
      if (seconds > pause || work.rhs >= pause_at) return {Stop::pause, now.t};
    }
  }
}

// Where no budget is given, what would take hours is told in seconds: a motion that runs away turns ever faster.
std::optional<Stop> Loop::keep_pace(double until) {
  constexpr long many = 1'000'000;
  constexpr double longest = 1e9;
  const long done = work.rhs - paced_;
  if (options_.max_rhs < unlimited || done < many) return std::nullopt;
  const double rest = static_cast<double>(done) * (until - now.t) / (now.t - paced_at_);
  if (!(rest <= longest)) return Stop{Stop::pace, now.t, rest};
  paced_ = work.rhs, paced_at_ = now.t;
  return std::nullopt;
}

Stop Loop::within(double until) {
  if (!beyond_->motion->between(until, y_out_)) return unknown();
  t_present_ = until, y_present_ = y_out_;
  return {Stop::end, until};
}

void Loop::back() {
  if (!beyond_) return;
  now.t_old = now.t, now.y_old = now.y;
  now.t = t_present_, now.y = y_present_;
  now.h = std::min(now.h, now.t_new - now.t_old);
  beyond_.reset(), begun_ = false;
}

// What is sampled sees the state, and what is due acts from here on.
std::optional<Stop> Loop::sample() {
  if (!system->exact(now.t, now.y)) return trouble();
  system->core.set_velocity(system->v_tree);
  bool changed;
  if (!control->sample(system->measured(now.t), changed) || !system->sampled(now.y, changed)) return trouble();
  if (changed) jump();
  return {};
}

// Everything that has to be known before a step.
std::optional<Stop> Loop::begin(double bound) {
  if (!joints_known_)
    if (const auto stop = change_joints()) return stop;
  const bool anew = !begun_;
  if (anew) {
    if (!system->at_start(now.t, now.y)) return trouble();
    end_ = monitor_.at(*system);
    energy_.from(*system);
    const Accepted accepted = system->accept(now.t, now.y, system->margin());
    if (accepted == Accepted::refused) return Stop{Stop::chart, now.t, system->margin()};
    if (accepted != Accepted::kept) f_known_ = false;
    begun_ = true;
  }
  if (!f_known_) {
    f_known_ = (method_ ? *method_ : dop853_).evaluate_start();
    if (!f_known_) return trouble();
    events.begun();
    if (!method_) choose(bound);
  }
  return {};
}

std::optional<Stop> Loop::one_step(double bound, bool last) {
  if (const auto stop = begin(bound)) return stop;
  if (system->core.rank) {
    const double left = crossing_.left(end_, length_, reaches_ ? infinity : bound);
    if (std::isfinite(left)) {
      const double met = crossing_.over(left, length_);
      if (work.spent || control->problem.raised) return trouble();
      if (std::isfinite(met)) {
        if (tolerance_.rtol > fine_rtol) {
          tolerance_.rtol = fine_rtol, tolerance_.atol = std::min(tolerance_.atol, fine_rtol / 100);
          if (!jumped_ && now.t > begin_.t) {
            if (const auto stop = redo()) return stop;
            crossing_.expect(met);
            return {};
          }
        }
        return across(met, left, bound, last);
      }
    }
  }
  return ordinary(bound, last);
}

std::optional<Stop> Loop::ordinary(double bound, bool last) {
  if (!method_->step(bound)) return trouble();
  system->trouble = Trouble::none;
  if (!control->problem.says.empty() || control->problem.u.size()) control->problem = {};
  const double h = now.t_new - now.t;
  if (h < options_.min_step && now.t_new < bound) return Stop{Stop::min_step, now.t};
  const auto shorter = [&](double part) { return method_->retry(part * h), std::nullopt; };
  const bool can_be_shorter = h > shortest_known * (bound - now.t);
  if (!system->at_last(now.t_new, now.y_new)) return can_be_shorter ? shorter(0.5) : std::optional(trouble());
  if (energy_.at(*system, tolerance_.rtol, tolerance_.atol) > energy_change) {
    if (can_be_shorter) return shorter(0.5);
    return Stop{Stop::energy, now.t, energy_.change};
  }
  events.arrived();
  const RankMonitor::Rank after = monitor_.at(*system);
  const double margin = system->margin();
  if (system->core.rank) {
    const Crossing::Verdict verdict = crossing_.judge(end_, after);
    if (control->problem.raised || work.spent) return trouble();
    if (verdict.lost) {
      method_->between(verdict.t, y_out_);
      system->exact(verdict.t, y_out_);
      return Stop{Stop::rank, verdict.t, verdict.value};
    }
    if (verdict.part < 1.0) return shorter(verdict.part);
  }
  return made({method_, std::nan(""), after, margin}, bound, last);
}

std::optional<Stop> Loop::made(const Made& step, double bound, bool last) {
  if (!(now.t_new > until_)) return finish(step, bound, last);
  beyond_ = step;
  return {};
}

std::optional<Stop> Loop::finish(const Made& step, double bound, bool last) {
  const double h = now.t_new - now.t;
  const bool ordinary = std::isnan(step.met);
  if (const auto stop = keep(step, last)) {
    if (!ordinary || stop->why != Stop::output || !(h > shortest_known * (bound - now.t))) return stop;
    return method_->retry(0.5 * h), std::nullopt;
  }
  ++steps[number()];
  if (ordinary) return length_ = h, begun_ ? check_stiffness(bound) : std::nullopt;
  method_->forget();
  crossings.push_back(step.met);
  return {};
}

// Over a position where J loses rank, by the collocation step just found.
std::optional<Stop> Loop::across(double met, double left, double bound, bool last) {
  Collocation& motion = *crossing_.collocation;
  now.t_new = reaches_ ? motion.t : std::min(motion.t, bound), now.h_next = length_ > 0.0 ? length_ : left;
  motion.at(now.t_new, now.y_new);
  if (!system->exact(now.t_new, now.y_new)) return trouble();
  energy_.from(*system);
  const RankMonitor::Rank after = monitor_.at(*system);
  events.jump();
  const bool ends = last && now.t_new == bound;  // right there, perhaps: nothing has to go on from it
  if (!ends && !RankMonitor::kept(after)) return Stop{Stop::rank, now.t_new, after.value};
  if (!ends && !method_->evaluate(now.t_new, now.y_new, now.f_new)) return trouble();
  if (!ends) events.arrived();
  return made({&motion, met, after, system->margin()}, bound, last);
}

// Look at what happened in the step just made, and make its end the present state.
std::optional<Stop> Loop::keep(const Made& step, bool last) {
  if (!silent_ || system->core.joints.any()) {
    Interpolant& motion = *step.motion;
    double halt;
    if (const auto stop = look(motion, last, halt)) return stop;
    if (!silent_)
      if (const auto stop = outputs(motion, std::min(now.t_new, halt))) return stop;
    if (std::isfinite(halt)) {
      if (halt < now.t_new && !motion.between(halt, y_out_)) return unknown();
      now.t_old = now.t, now.y_old = now.y;
      now.y = halt < now.t_new ? y_out_ : now.y_new, now.t = halt;
      begun_ = false;
      jump(), events.jump();
      if (!events.halted()) return {};  // joints go on in another way
      if (system->core.joints.any() && now.t == now.t_old) recorder.drop_row_at(now.t);  // recorded before an impact
      if (!record_now()) return trouble();
      return Stop{Stop::event, now.t};
    }
  }
  const Accepted accepted = system->accept(now.t_new, now.y_new, step.margin);
  method_->commit();
  crossing_.kept(step.after);
  end_ = step.after, energy_.kept();
  f_known_ = accepted == Accepted::kept;
  if (accepted == Accepted::refused) return Stop{Stop::chart, now.t, step.margin};
  if (accepted == Accepted::restarted) method_->forget();
  return system->core.joints.any() ? keep_joints() : std::nullopt;
}

std::optional<Stop> Loop::look(Interpolant& motion, bool last, double& halt) {
  if (events.check(motion, last, silent_, halt)) return {};
  return event_failure();
}

// Why an event's function has no value.
Stop Loop::event_failure() {
  if (events.failed >= 0) return Stop{Stop::function, now.t, events.failed_value, events.failed};
  return unknown();
}

std::optional<Stop> Loop::outputs(Interpolant& motion, double until) {
  for (until = std::min(until, last_instant_); recorder.due(until); recorder.passed()) {
    const double t = recorder.instant();
    if (t == now.t_new)
      y_out_ = now.y_new;
    else if (!motion.between(t, y_out_))
      return unknown();
    if (!recorder.add(*system, t, y_out_)) return unknown();
  }
  return {};
}

// Why a state within a step cannot be known.
Stop Loop::unknown() {
  const Stop stop = trouble();
  return stop.why == Stop::step ? Stop{Stop::output, now.t} : stop;
}

bool Loop::record_now() { return recorder.add(*system, t(), y()); }

// Come to the present time once more from the start, with the finer tolerance.
std::optional<Stop> Loop::redo() {
  const double until = now.t;
  begin_joints();
  system->start(begin_.t, begin_.q_tree, begin_.v_tree, begin_.w, now.y);
  now.t = now.t_old = begin_.t, now.h = (until - now.t) / 10;
  begun_ = f_known_ = false, length_ = 0.0;
  method_->forget();
  crossing_.begin();
  silent_ = true, reaches_ = false;
  std::optional<Stop> stop;
  while (now.t < until && !stop) stop = one_step(until, false);
  silent_ = false;
  if (!stop) stop = begin(infinity);
  return stop;
}

// Why no step can be made.
Stop Loop::trouble() {
  if (control->problem.raised) return {Stop::raised, now.t};
  if (work.spent) return {Stop::rhs_budget, now.t};
  if (system->trouble == Trouble::control || !control->problem.says.empty() || control->problem.u.size())
    return {Stop::control, now.t};
  return {Stop::step, now.t};
}

}  // namespace ckc
