#include "loop.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "stiffness.hpp"

namespace ckc {

using Clock = std::chrono::steady_clock;

// At least, in a run that crosses losses of rank: with less they come out up to 1e-2 off after ten seconds.
constexpr double fine_rtol = 1e-7;
constexpr long first_check = 50;     // steps after which stiffness is looked at again, then twice as many
constexpr double shortest_told = 1e-9;  // of what is left: a step whose end, or inside, cannot be told is made again
constexpr double energy_change = 100.0;  // of a conservative motion in a step, in tolerances: a wrong step, not an error
constexpr double few_steps = 2.0;    // of RK45: a segment that takes no more is its
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
      crossing_(*system, method_, now, monitor_, collocation_of(*system, work), options_.closed) {
  for (Vector* x : {&now.y, &now.f, &now.y_new, &now.f_new, &now.y_old, &y_out_, &y_present_}) x->setZero(system->size);
}

void Loop::start(double t, In q_tree, In v_tree, In w) {
  tolerance_.rtol = options_.rtol, tolerance_.atol = options_.atol;
  begin_ = {t, q_tree, v_tree, w};
  work = {}, work.most_rhs = options_.max_rhs;
  system->counts = {}, system->trouble = Trouble::none;
  control->problem = {};
  control->begin();
  system->start(t, q_tree, v_tree, w, now.y);
  now.t = now.t_old = t, now.y_old = now.y, now.h = 0.0;
  steps = {}, crossings.clear(), kept_ = 0, check_at_ = 0, length_ = 0.0;
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
  if (method_) method_->forget();
}

void Loop::hold(In u) {
  if (control->held == u) return;
  control->held = u;
  jump();
}

Stop Loop::advance(double until, bool final, double pause, double budget) {
  const auto started = Clock::now();
  const auto spent = [&] { return std::chrono::duration<double>(Clock::now() - started).count(); };
  system->may_switch = !control->acts();
  const double from = t();
  until_ = until, ++unchanged_;
  if (beyond_) {
    if (until < now.t_new) return within(until);
    const Made step = *beyond_;
    beyond_.reset();
    if (const auto stop = finish(step, now.t_new, false)) return *stop;
  }
  if (control->acts()) {
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
      if (!recorder.add(*system, recorder.instant(), now.y)) return untold();
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
      const double seconds = spent();
      if (seconds > budget) return {Stop::wall_budget, now.t};
      if (seconds > pause) return {Stop::pause, now.t};
    }
  }
}

Stop Loop::within(double until) {
  if (!beyond_->motion->between(until, y_out_)) return untold();
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
  system->core.inertia(), system->core.bias(system->v_tree);
  held_before_ = control->held;
  if (!control->sample(system->measured(now.t))) return trouble();
  if (control->held != held_before_) jump();
  return {};
}

// Everything that has to be known before a step.
std::optional<Stop> Loop::begin(double bound) {
  if (!begun_) {
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
    if (!method_) choose(bound);
  }
  return {};
}

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
  const bool may_be_stiff = options_.method == "auto" && (control->feedback() || system->core.springs.any_damping);
  if (options_.method == "Radau" || (may_be_stiff && is_stiff(bound - now.t))) {
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

bool Loop::is_stiff(double duration) {
  Matrix jacobian;
  ++work.jacobians;
  return system->jacobian(now.t, now.y, now.f, jacobian, work.rhs) && system->modes(now.y, jacobian) &&
         stiff(jacobian, duration);
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
  const bool can_be_shorter = h > shortest_told * (bound - now.t);
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
    if (!ordinary || stop->why != Stop::output || !(h > shortest_told * (bound - now.t))) return stop;
    return method_->retry(0.5 * h), std::nullopt;
  }
  ++steps[number()];
  if (ordinary) return length_ = h, check_stiffness(bound);
  method_->forget();
  crossings.push_back(step.met);
  return {};
}

// After a while, and then after twice as long: what was not stiff at the start may have become so.
std::optional<Stop> Loop::check_stiffness(double bound) {
  if (!check_at_ || ++kept_ < check_at_) return {};
  check_at_ *= 2;
  if (const auto stop = begin(bound)) return stop;
  if (now.t < bound && is_stiff(bound - now.t)) check_at_ = 0, take_implicit();
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
  events.arrived();
  return made({&motion, met, after, system->margin()}, bound, last);
}

// Look at what happened in the step just made, and make its end the present state.
std::optional<Stop> Loop::keep(const Made& step, bool last) {
  if (!silent_) {
    Interpolant& motion = *step.motion;
    double halt;
    if (const auto stop = look(motion, last, halt)) return stop;
    if (const auto stop = outputs(motion, std::min(now.t_new, halt))) return stop;
    if (std::isfinite(halt)) {
      if (halt < now.t_new && !motion.between(halt, y_out_)) return untold();
      now.t_old = now.t, now.y_old = now.y;
      now.y = halt < now.t_new ? y_out_ : now.y_new, now.t = halt;
      begun_ = false;
      jump(), events.jump();
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
  return {};
}

std::optional<Stop> Loop::look(Interpolant& motion, bool last, double& halt) {
  if (events.check(motion, last, halt)) return {};
  if (events.failed >= 0) return Stop{Stop::function, now.t, events.failed_value, events.failed};
  return untold();
}

std::optional<Stop> Loop::outputs(Interpolant& motion, double until) {
  for (until = std::min(until, last_instant_); recorder.due(until); recorder.passed()) {
    const double t = recorder.instant();
    if (t == now.t_new)
      y_out_ = now.y_new;
    else if (!motion.between(t, y_out_))
      return untold();
    if (!recorder.add(*system, t, y_out_)) return untold();
  }
  return {};
}

// Why a state within a step cannot be told.
Stop Loop::untold() {
  const Stop stop = trouble();
  return stop.why == Stop::step ? Stop{Stop::output, now.t} : stop;
}

bool Loop::record_now() { return recorder.add(*system, t(), y()); }

// Come to the present time once more from the start, with the finer tolerance.
std::optional<Stop> Loop::redo() {
  const double until = now.t;
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
