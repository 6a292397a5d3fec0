#include "motion/events.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double place_rounding = 1e-15;  // rad, or of the mechanism's size
constexpr double least_known = 1e-9;  // rad/s, m/s: a rate that is nearer to zero where a motion begins may be zero
constexpr double time_tolerance = 2e-12;  // s: two functions that cross zero at once are found no further apart

Events::Events(System& system, Step& step, std::vector<Event> events)
    : system_(system), step_(step), events_(std::move(events)), places_(walk_places()) {
  const Core& core = system.core;
  add_own();
  const auto count = static_cast<Eigen::Index>(events_.size());
  for (End* end : {&start_, &end_}) end->q.setZero(core.n), end->v.setZero(core.n), end->a.setZero(core.n);
  walks_.resize(events_.size());
  values_.setZero(places_.size(), count), y_.setZero(system.size), coordinates_.setZero(core.n);
  begin();
}

void Events::add_own() {
  const Joints& joints = system_.core.joints;
  const auto add = [&](Event::Of of, int k, double value) {
    Event event;
    event.of = of, event.coordinate = k, event.value = value, event.stop = event.own = true;
    events_.push_back(event);
  };
  for (int k = 0; k < system_.core.n; ++k) {
    if (joints.rubs_at(k)) add(Event::q_dot, k, 0.0);
    for (double stop : {joints.table.lower(k), joints.table.upper(k)})
      if (std::isfinite(stop)) add(Event::q, k, stop);
  }
  if (joints.any()) add(Event::holding, 0, 0.0);
}

void Events::begin() {
  met.clear(), changing.clear();
  signs_.assign(events_.size(), 0), active_.assign(events_.size(), 1);
  crossed_at_.assign(events_.size(), std::numeric_limits<double>::quiet_NaN()), largest_.assign(events_.size(), 0.0);
  resting_.assign(events_.size(), 0), joints_changed_ = false;
  jump();
}

// What a joint is off zero where its motion begins counts as zero: it comes of how exactly an event is located. A joint
// that is off its stop is known to be, however little that is.
void Events::monitor_joints(In coordinates, In velocity, double within) {
  const Joints& joints = system_.core.joints;
  changing.clear();
  joints_changed_ = true, change_time_tolerance_ = within;
  for (size_t i = 0; i < events_.size(); ++i) {
    Event& event = events_[i];
    if (!event.own) {
      last_[i] = std::numeric_limits<double>::quiet_NaN();
      continue;
    }
    const int k = event.coordinate;
    double here = 0.0;
    if (event.of == Event::q_dot) {
      signs_[i] = joints.sign[k], active_[i] = joints.sign[k] != 0, here = velocity(k);
    } else if (event.of == Event::q) {
      const int side = event.value == joints.table.lower(k) ? -1 : 1;
      signs_[i] = -side, active_[i] = joints.touch[k] != side, here = coordinates(k) - event.value;
    } else {
      signs_[i] = 1, active_[i] = !joints.locked.empty();
    }
    event.floor = here * signs_[i] > (event.of == Event::q ? 0.0 : least_known) ? 0.0 : 2.0 * std::abs(here);
    // A joint that leaves its stop from rest may move into it first, by what rounding made of its rate.
    if (event.of == Event::q) event.floor = std::max(event.floor, place_rounding * joints.table.reach(k));
  }
}

void Events::jump() {
  known_ = false, end_holds_ = std::numeric_limits<double>::quiet_NaN();
  last_.assign(events_.size(), std::numeric_limits<double>::quiet_NaN());
}

// The core is at the end of a step, which the right-hand side was evaluated at last, as f.
void Events::take_end(End& end, In f) {
  system_.core.tree.to_coordinates(system_.core.q_tree, end.q);
  end.v = system_.velocity;
  end.accelerated = system_.tree_acceleration(f, end.a);
}

double Events::holding() const {
  Core& core = system_.core;
  return core.joints.locked.empty() ? std::numeric_limits<double>::quiet_NaN() : core.holding_margin();
}

void Events::begun() {
  if (events_.empty()) return;
  if (values_at_ != step_.t) jump();
  take_end(start_, step_.f), known_ = true, values_at_ = step_.t;
  for (size_t k = 0; k < events_.size(); ++k)
    if (events_[k].of == Event::holding) last_[k] = holding();
}

bool Events::at(Interpolant& motion, double t) {
  closed_ = only_y;
  if (t == step_.t_new)
    y_ = step_.y_new;
  else if (t == step_.t)
    y_ = step_.y;
  else
    return motion.between(t, y_);
  return true;
}

bool Events::place(double t, Closed wanted) {
  if (closed_ >= wanted) return true;
  closed_ = wanted;
  if (wanted == as_y_is) return system_.as_is(t, y_);
  if (!system_.exact(t, y_)) return false;
  bool changed = wanted == at_rest && !system_.core.joints.locked.empty();
  for (int k = 0; k < 2 && changed; ++k)  // twice: moving a joint to its place changes the rates
    if (!system_.keep_locked(y_, 0.0, changed) || !system_.exact(t, y_)) return false;
  return true;
}

bool Events::value(int k, double t, double& gap) {
  const Event& event = events_[k];
  if (event.of <= Event::q_dot && system_.shows(y_, event.coordinate, event.of == Event::q_dot, gap))
    return gap = event.sign * (gap - event.value), true;
  return event.of == Event::holding ? place(t, as_y_is) && value_there(k, t, gap) : exact_value(k, t, gap);
}

bool Events::exact_value(int k, double t, double& gap) {
  return place(t, events_[k].of == Event::function ? at_rest : exactly) && value_there(k, t, gap);
}

bool Events::value_there(int k, double t, double& gap) {
  const Event& event = events_[k];
  Core& core = system_.core;
  switch (event.of) {
    case Event::q:
      core.tree.to_coordinates(core.q_tree, coordinates_);
      gap = coordinates_(event.coordinate) - event.value;
      break;
    case Event::q_dot:
      gap = system_.velocity(event.coordinate) - event.value;
      break;
    case Event::sigma_min_phi_z:
      core.jacobian();
      phi_z_.resize(core.rows.J.rows(), static_cast<Eigen::Index>(core.z.size()));
      for (size_t j = 0; j < core.z.size(); ++j) phi_z_.col(j) = core.rows.J.col(core.z[j]);
      gap = svd_phi_z_.compute(phi_z_).singularValues()(core.rank - 1) - event.value;
      break;
    case Event::sigma_min_J:
      core.jacobian();
      gap = svd_J_.compute(core.rows.J).singularValues()(core.rank - 1) - event.value;
      break;
    case Event::function:
      if (!event.call(t, system_, gap)) return false;
      break;
    case Event::holding:
      if (!system_.acceleration(t, coordinates_)) return false;
      gap = core.holding_margin();
  }
  gap *= event.sign;
  if (std::isfinite(gap)) return true;
  failed = k, failed_value = gap;
  return false;
}

void Events::arrived() {
  if (!events_.empty()) take_end(end_, step_.f_new), end_holds_ = holding();
}

bool Events::sample(Interpolant& motion, Eigen::Index first, Eigen::Index stride) {
  const double h = step_.t_new - step_.t;
  for (Eigen::Index i = first; i < places_.size(); i += stride) {
    const bool ends = i + 1 == places_.size();
    const double t = ends ? step_.t_new : step_.t + h * places_(i);
    if (!at(motion, t)) return false;
    for (int k : wanted_) {
      double known = std::numeric_limits<double>::quiet_NaN();
      if (i == 0 && values_at_ == step_.t) known = last_[k];
      if (ends && events_[k].of == Event::holding) known = end_holds_;
      if (!std::isnan(known))
        values_(i, k) = known;
      else if (!value(k, t, values_(i, k)))
        return false;
    }
  }
  return true;
}

// Of a coordinate or a rate, where both ends of the step are known: it begins on the side where the last one ended, unless
// an impact has taken a rate over its value.
bool Events::goes_on(int k) const {
  const Event& event = events_[k];
  const double here = (event.of == Event::q ? start_.q : start_.v)(event.coordinate) - event.value;
  return event.sign * here * signs_[k] > 0.0;
}

bool Events::check(Interpolant& motion, bool last, bool silent, double& halt) {
  halt = std::numeric_limits<double>::infinity();
  if (events_.empty()) return true;
  wanted_.clear(), sampled_.clear(), found_.clear();
  for (int k = 0; k < static_cast<int>(events_.size()); ++k) {
    const Event& event = events_[k];
    if (!active_[k] || (silent && !event.own)) continue;
    if (is_held(event)) {
      const double gap = held_value(event);
      if (joints_changed_) report_arrival(k, std::abs(gap) <= event.floor ? 0 : gap > 0 ? 1 : -1, halt);
    } else if (!(signs_[k] && ((ruled_out(event) && goes_on(k)) || holds_by_far(k)))) {
      wanted_.push_back(k);
    }
  }
  if (!wanted_.empty()) {
    const bool locked = std::any_of(wanted_.begin(), wanted_.end(), [&](int k) { return events_[k].of == Event::holding; });
    if (!sample(motion, 0, locked ? 2 : 1)) return false;
    sampled_ = wanted_;
    wanted_.erase(std::remove_if(wanted_.begin(), wanted_.end(), [&](int k) { return holds(k); }), wanted_.end());
    if (!wanted_.empty() && !((!locked || sample(motion, 1, 2)) && find(motion, last, halt))) return false;
  }
  if (!wanted_.empty() || !found_.empty()) report(halt);
  joints_changed_ = joints_changed_ && silent;
  values_at_ = step_.t_new;
  std::fill(last_.begin(), last_.end(), std::numeric_limits<double>::quiet_NaN());
  known_ = !std::isfinite(halt);
  if (known_)
    for (size_t k = 0; k < events_.size(); ++k)
      if (events_[k].of == Event::holding) last_[k] = end_holds_;
  if (known_)
    for (int k : sampled_) last_[k] = values_(places_.size() - 1, k);
  std::swap(start_, end_);
  return true;
}

bool Events::find(Interpolant& motion, bool last, double& halt) {
  const bool resting = !system_.core.joints.locked.empty();
  for (int k : wanted_) {
    const auto value_at = [&](double t, double& there) { return at(motion, t) && value(k, t, there); };
    const auto exact_at = [&](double t, double& there) { return at(motion, t) && exact_value(k, t, there); };
    const Gap gap = std::cref(value_at), exact = std::cref(exact_at);  // which allocate nothing
    const Event& event = events_[k];
    const bool rough = event.of <= Event::q_dot || event.of == Event::holding;
    Walk& walked = walks_[k];
    double floor = event.floor;
    if (!event.own) {
      largest_[k] = std::max(largest_[k], values_.col(k).cwiseAbs().maxCoeff());
      if (event.of == Event::function && resting) floor = function_rounding * std::max(1.0, largest_[k]);
      // A function that was on zero until joints changed, or has just come there, counts as zero where the step begins.
      const double first = std::abs(values_(0, k));
      const bool was_zero = signs_[k] ? has_just_crossed(k) : resting_[k] != 0;
      if (joints_changed_ && was_zero && first <= zero_tolerance * largest_[k]) floor = std::max(floor, 2.0 * first);
    }
    if (!walk(gap, step_.t, step_.t_new, values_.col(k), signs_[k], floor, walked, rough ? &exact : nullptr)) return false;
    if (!event.own && stays_on_value(k)) {
      walked.found.clear(), walked.sign = signs_[k];
      if (joints_changed_) report_arrival(k, 0, halt), walked.sign = signs_[k];
      continue;
    }
    if (last && walked.on_zero && walked.sign && !event.own) walked.found.emplace_back(step_.t_new, -walked.sign);
    for (const auto& [t, direction] : walked.found) {
      if (event.direction != 0 && event.direction != direction) continue;
      found_.push_back({t, k, direction});
      if (event.stop) halt = std::min(halt, t);
    }
  }
  return true;
}

// Report the events until the step is halted. If joints change at that time, an event that is found a rounding later belongs
// to the same instant: the motion behind it is never made.
void Events::report(double halt) {
  std::sort(found_.begin(), found_.end(), [](const Crossed& a, const Crossed& b) {
    return a.t != b.t ? a.t < b.t : a.event < b.event;
  });
  changing.clear(), halted_ = false;
  const bool changes = std::any_of(found_.begin(), found_.end(), [&](const Crossed& crossed) {
    return crossed.t == halt && events_[crossed.event].own;
  });
  const double until = changes ? halt + time_tolerance : halt;
  for (const Crossed& crossed : found_) {
    const Event& event = events_[crossed.event];
    if (crossed.t > (event.own ? halt : until)) continue;
    if (event.own)
      changing.push_back(event);
    else
      met.push_back({std::min(crossed.t, halt), crossed.event, crossed.direction}), halted_ |= event.stop;
  }
  for (int k : wanted_) {
    if (!std::isfinite(halt)) signs_[k] = walks_[k].sign;
    for (const auto& [t, direction] : walks_[k].found)  // the sign that a function goes on with from there
      if (t <= (events_[k].own ? halt : until)) signs_[k] = direction, crossed_at_[k] = std::min(t, halt);
  }
}

}  // namespace ckc
