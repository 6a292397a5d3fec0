#include "motion/events.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double coordinate_rounding = 1e-15;  // rad, or relative to the mechanism's size
constexpr double min_nonzero_rate = 1e-9;      // rad/s, m/s; smaller rates at the start of a motion count as zero
constexpr double simultaneous_time_tolerance = 2e-12;  // s; computed times of simultaneous events differ by less

Events::Events(System& system, Step& step, std::vector<Event> events)
    : system_(system), step_(step), events_(std::move(events)), sample_points_(sample_points()) {
  const Core& core = system.core;
  add_joint_events();
  const auto count = static_cast<Eigen::Index>(events_.size());
  for (End* end : {&start_, &end_}) end->q.setZero(core.n), end->v.setZero(core.n), end->a.setZero(core.n);
  searches_.resize(events_.size());
  values_.setZero(sample_points_.size(), count), y_.setZero(system.size), coordinates_.setZero(core.n);
  reset();
}

void Events::add_joint_events() {
  const Joints& joints = system_.core.joints;
  const auto add = [&](Event::Quantity quantity, int k, double value) {
    Event event;
    event.quantity = quantity, event.coordinate = k, event.value = value, event.stop = event.is_joint_event = true;
    events_.push_back(event);
  };
  for (int k = 0; k < system_.core.n; ++k) {
    if (joints.has_friction_at(k)) add(Event::q_dot, k, 0.0);
    for (double stop : {joints.table.lower(k), joints.table.upper(k)})
      if (std::isfinite(stop)) add(Event::q, k, stop);
  }
  if (joints.has_events()) add(Event::holding_margin, 0, 0.0);
}

void Events::reset() {
  occurrences.clear(), joint_events.clear();
  signs_.assign(events_.size(), 0), active_.assign(events_.size(), 1);
  crossed_at_.assign(events_.size(), std::numeric_limits<double>::quiet_NaN()), largest_.assign(events_.size(), 0.0);
  resting_.assign(events_.size(), 0), joints_changed_ = false;
  restart();
}

// A small rate of a joint at the start of its motion counts as zero, since events are located with a tolerance. An
// offset from a stop is exact, however small it is.
void Events::monitor_joints(In coordinates, In velocity, double time_tolerance) {
  const Joints& joints = system_.core.joints;
  joint_events.clear();
  joints_changed_ = true, change_time_tolerance_ = time_tolerance;
  for (size_t i = 0; i < events_.size(); ++i) {
    Event& event = events_[i];
    if (!event.is_joint_event) {
      last_values_[i] = std::numeric_limits<double>::quiet_NaN();
      continue;
    }
    const int k = event.coordinate;
    double offset = 0.0;
    if (event.quantity == Event::q_dot) {
      signs_[i] = joints.sliding_direction[k], active_[i] = joints.sliding_direction[k] != 0, offset = velocity(k);
    } else if (event.quantity == Event::q) {
      const int side = event.value == joints.table.lower(k) ? -1 : 1;
      signs_[i] = -side, active_[i] = joints.stop_side[k] != side, offset = coordinates(k) - event.value;
    } else {
      signs_[i] = 1, active_[i] = !joints.locked.empty();
    }
    event.zero_threshold =
        offset * signs_[i] > (event.quantity == Event::q ? 0.0 : min_nonzero_rate) ? 0.0 : 2.0 * std::abs(offset);
    // Rounding of its rate may move a joint into its stop before it leaves.
    if (event.quantity == Event::q)
      event.zero_threshold = std::max(event.zero_threshold, coordinate_rounding * joints.table.reach(k));
  }
}

void Events::restart() {
  start_is_known_ = false, end_holding_margin_ = std::numeric_limits<double>::quiet_NaN();
  last_values_.assign(events_.size(), std::numeric_limits<double>::quiet_NaN());
}

// Store coordinates, velocities and accelerations at an end of the step, where `f` was evaluated last.
void Events::record_end(End& end, In f) {
  system_.core.tree.to_coordinates(system_.core.q_tree, end.q);
  end.v = system_.velocity;
  end.has_acceleration = system_.tree_acceleration(f, end.a);
}

double Events::holding_margin() const {
  Core& core = system_.core;
  return core.joints.locked.empty() ? std::numeric_limits<double>::quiet_NaN() : core.holding_margin();
}

void Events::start_step() {
  if (events_.empty()) return;
  if (last_values_time_ != step_.t) restart();
  record_end(start_, step_.f), start_is_known_ = true, last_values_time_ = step_.t;
  for (size_t k = 0; k < events_.size(); ++k)
    if (events_[k].quantity == Event::holding_margin) last_values_[k] = holding_margin();
}

bool Events::set_state(Interpolant& motion, double t) {
  core_accuracy_ = not_set;
  if (t == step_.t_new)
    y_ = step_.y_new;
  else if (t == step_.t)
    y_ = step_.y;
  else
    return motion.interpolate(t, y_);
  return true;
}

bool Events::set_core(double t, CoreAccuracy required) {
  if (core_accuracy_ >= required) return true;
  core_accuracy_ = required;
  if (required == unprojected) return system_.sync_core_unprojected(t, y_);
  if (!system_.sync_core(t, y_)) return false;
  bool changed = required == joints_at_rest && !system_.core.joints.locked.empty();
  for (int k = 0; k < 2 && changed; ++k)  // correcting positions changes rates, so repeat once
    if (!system_.correct_locked_joints(y_, 0.0, changed) || !system_.sync_core(t, y_)) return false;
  return true;
}

bool Events::event_value(int k, double t, double& value) {
  const Event& event = events_[k];
  if (event.quantity <= Event::q_dot &&
      system_.read_from_state(y_, event.coordinate, event.quantity == Event::q_dot, value))
    return value = event.sign * (value - event.value), true;
  return event.quantity == Event::holding_margin ? set_core(t, unprojected) && value_at_core(k, t, value)
                                                 : exact_value(k, t, value);
}

bool Events::exact_value(int k, double t, double& value) {
  return set_core(t, events_[k].quantity == Event::function ? joints_at_rest : projected) && value_at_core(k, t, value);
}

bool Events::value_at_core(int k, double t, double& value) {
  const Event& event = events_[k];
  Core& core = system_.core;
  switch (event.quantity) {
    case Event::q:
      core.tree.to_coordinates(core.q_tree, coordinates_);
      value = coordinates_(event.coordinate) - event.value;
      break;
    case Event::q_dot: value = system_.velocity(event.coordinate) - event.value; break;
    case Event::sigma_min_phi_z:
      core.compute_J();
      phi_z_.resize(core.constraints.J().rows(), static_cast<Eigen::Index>(core.z.size()));
      for (size_t j = 0; j < core.z.size(); ++j) phi_z_.col(j) = core.constraints.J().col(core.z[j]);
      value = svd_phi_z_.compute(phi_z_).singularValues()(core.rank - 1) - event.value;
      break;
    case Event::sigma_min_J:
      core.compute_J();
      value = svd_J_.compute(core.constraints.J()).singularValues()(core.rank - 1) - event.value;
      break;
    case Event::function:
      if (!event.evaluate(t, system_, value)) return false;
      break;
    case Event::holding_margin:
      if (!system_.acceleration(t, coordinates_)) return false;
      value = core.holding_margin();
  }
  value *= event.sign;
  if (std::isfinite(value)) return true;
  failed = k, failed_value = value;
  return false;
}

void Events::end_step() {
  if (!events_.empty()) record_end(end_, step_.f_new), end_holding_margin_ = holding_margin();
}

bool Events::sample_values(Interpolant& motion, Eigen::Index first, Eigen::Index stride) {
  const double h = step_.t_new - step_.t;
  for (Eigen::Index i = first; i < sample_points_.size(); i += stride) {
    const bool is_end = i + 1 == sample_points_.size();
    const double t = is_end ? step_.t_new : step_.t + h * sample_points_(i);
    if (!set_state(motion, t)) return false;
    for (int k : to_search_) {
      double known_value = std::numeric_limits<double>::quiet_NaN();
      if (i == 0 && last_values_time_ == step_.t) known_value = last_values_[k];
      if (is_end && events_[k].quantity == Event::holding_margin) known_value = end_holding_margin_;
      if (!std::isnan(known_value))
        values_(i, k) = known_value;
      else if (!event_value(k, t, values_(i, k)))
        return false;
    }
  }
  return true;
}

// Whether a coordinate or rate starts the step with its previous sign. An impact may move a rate across its value.
bool Events::continues_on_same_side(int k) const {
  const Event& event = events_[k];
  const double offset = (event.quantity == Event::q ? start_.q : start_.v)(event.coordinate) - event.value;
  return event.sign * offset * signs_[k] > 0.0;
}

bool Events::find_events(Interpolant& motion, bool last, bool joints_only, double& stop_time) {
  stop_time = std::numeric_limits<double>::infinity();
  if (events_.empty()) return true;
  to_search_.clear(), sampled_.clear(), new_occurrences_.clear();
  for (int k = 0; k < static_cast<int>(events_.size()); ++k) {
    const Event& event = events_[k];
    if (!active_[k] || (joints_only && !event.is_joint_event)) continue;
    if (is_held(event)) {
      const double value = held_value(event);
      if (joints_changed_)
        report_arrival(k, std::abs(value) <= event.zero_threshold ? 0 : value > 0 ? 1 : -1, stop_time);
    } else if (!(signs_[k] && ((is_excluded(event) && continues_on_same_side(k)) || joints_clearly_held(k)))) {
      to_search_.push_back(k);
    }
  }
  if (!to_search_.empty()) {
    const bool searches_holding_margin = std::any_of(
        to_search_.begin(), to_search_.end(), [&](int k) { return events_[k].quantity == Event::holding_margin; });
    if (!sample_values(motion, 0, searches_holding_margin ? 2 : 1)) return false;
    sampled_ = to_search_;
    to_search_.erase(
        std::remove_if(to_search_.begin(), to_search_.end(), [&](int k) { return joints_hold_throughout(k); }),
        to_search_.end());
    if (!to_search_.empty()) {
      if (searches_holding_margin && !sample_values(motion, 1, 2)) return false;
      if (!search_step(motion, last, stop_time)) return false;
    }
  }
  if (!to_search_.empty() || !new_occurrences_.empty()) report_occurrences(stop_time);
  joints_changed_ = joints_changed_ && joints_only;
  last_values_time_ = step_.t_new;
  std::fill(last_values_.begin(), last_values_.end(), std::numeric_limits<double>::quiet_NaN());
  start_is_known_ = !std::isfinite(stop_time);
  if (start_is_known_)
    for (size_t k = 0; k < events_.size(); ++k)
      if (events_[k].quantity == Event::holding_margin) last_values_[k] = end_holding_margin_;
  if (start_is_known_)
    for (int k : sampled_) last_values_[k] = values_(sample_points_.size() - 1, k);
  std::swap(start_, end_);
  return true;
}

bool Events::search_step(Interpolant& motion, bool last, double& stop_time) {
  const bool resting = !system_.core.joints.locked.empty();
  for (int k : to_search_) {
    const auto value_at = [&](double t, double& result) { return set_state(motion, t) && event_value(k, t, result); };
    const auto exact_at = [&](double t, double& result) { return set_state(motion, t) && exact_value(k, t, result); };
    const ScalarFunction value = std::cref(value_at), exact = std::cref(exact_at);  // references avoid allocations
    const Event& event = events_[k];
    const bool has_cheap_value = event.quantity <= Event::q_dot || event.quantity == Event::holding_margin;
    RootSearch& search = searches_[k];
    double zero_threshold = event.zero_threshold;
    if (!event.is_joint_event) {
      largest_[k] = std::max(largest_[k], values_.col(k).cwiseAbs().maxCoeff());
      if (event.quantity == Event::function && resting) zero_threshold = function_rounding * std::max(1.0, largest_[k]);
      // A function that was zero until the joint modes changed, or has just reached zero, counts as zero at the start.
      const double first = std::abs(values_(0, k));
      const bool was_zero = signs_[k] ? has_just_crossed(k) : resting_[k] != 0;
      if (joints_changed_ && was_zero && first <= relative_zero_tolerance * largest_[k])
        zero_threshold = std::max(zero_threshold, 2.0 * first);
    }
    if (!search.find(value, {step_.t, step_.t_new}, values_.col(k), signs_[k], zero_threshold,
                     has_cheap_value ? &exact : nullptr))
      return false;
    if (!event.is_joint_event && stays_on_value(k)) {
      search.sign_changes.clear(), search.sign = signs_[k];
      if (joints_changed_) report_arrival(k, 0, stop_time), search.sign = signs_[k];
      continue;
    }
    if (last && search.on_zero && search.sign && !event.is_joint_event)
      search.sign_changes.emplace_back(step_.t_new, -search.sign);
    for (const auto& [t, direction] : search.sign_changes) {
      if (event.direction != 0 && event.direction != direction) continue;
      new_occurrences_.push_back({t, k, direction});
      if (event.stop || event.switches_joints) stop_time = std::min(stop_time, t);
    }
  }
  return true;
}

// Report the events up to the stop. If joint modes change at that time, events a rounding error later belong to the
// same instant, because the motion continues differently from there.
void Events::report_occurrences(double stop_time) {
  std::sort(new_occurrences_.begin(), new_occurrences_.end(), [](const EventOccurrence& a, const EventOccurrence& b) {
    return a.t != b.t ? a.t < b.t : a.event < b.event;
  });
  joint_events.clear(), switching.clear(), stopped_ = false;
  const auto changes_modes = [&](const EventOccurrence& occurrence) {
    return occurrence.t == stop_time && events_[occurrence.event].is_joint_event;
  };
  const bool modes_change = std::any_of(new_occurrences_.begin(), new_occurrences_.end(), changes_modes);
  const double until = modes_change ? stop_time + simultaneous_time_tolerance : stop_time;
  for (const EventOccurrence& occurrence : new_occurrences_) {
    const Event& event = events_[occurrence.event];
    if (occurrence.t > (event.is_joint_event ? stop_time : until)) continue;
    if (event.is_joint_event) {
      joint_events.push_back(event);
      continue;
    }
    occurrences.push_back({std::min(occurrence.t, stop_time), occurrence.event, occurrence.direction});
    stopped_ |= event.stop;
    if (event.switches_joints) switching.push_back(occurrence.event);
  }
  for (int k : to_search_) {
    if (!std::isfinite(stop_time)) signs_[k] = searches_[k].sign;
    for (const auto& [t, direction] : searches_[k].sign_changes)  // sign after the crossing
      if (t <= (events_[k].is_joint_event ? stop_time : until))
        signs_[k] = direction, crossed_at_[k] = std::min(t, stop_time);
  }
}

}  // namespace ckc
