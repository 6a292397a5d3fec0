// Transitions of joint modes at an instant: impacts, and the choice of which joints slide, stick or touch. Both are
// convex problems in the metric of D', over velocities and over accelerations.
#pragma once

#include <optional>

#include "motion/events.hpp"

namespace ckc {

class JointModeTransitions {
 public:
  // `min_rise`: rad, or relative to the mechanism's size. Bounces that rise less are suppressed.
  JointModeTransitions(System& system, double min_rise, const Tolerance& tolerance);

  void reset();  // at the start of a motion
  // Update the joint modes at y after these events. `time_tolerance`: s, of the events' times. If velocities jump, y is
  // changed. False if it fails: the system's `failure` says why; if it is `none`, no contact forces exist.
  bool update(double t, Out y, const std::vector<Event>& triggered, double time_tolerance);
  Vector coordinates;                  // (n), of the state of the update
  double first_bounce_duration = 0.0;  // s, until the first bounce returns to its stop; infinite if there is none

 private:
  bool sync_state(double t, Out y);  // sync the core with y, and write the projected state to y
  // Joints that come to rest or reach a stop at this instant.
  std::vector<JointArrival> find_arrivals(const std::vector<Event>& triggered) const;
  // `energy`: kinetic energy before an impact, J; none without an impact
  bool resolve_impacts(double t, Out y, std::optional<double>& energy);
  bool resolve_holding(double t, Out y, const Indices& previously_locked);
  // Remove coordinates from `candidates` that the loops do not allow to move, and their columns from responses_.
  // False if J has lost rank.
  bool keep_movable(Indices& candidates);
  void scale_responses(const Indices& candidates);  // computes A_, the dimensionless responses to unit forces
  bool is_at_rest(int k) const { return std::abs(v_(k)) <= rest_speed_(k); }
  bool approaches_stop(int k) const { return nearby_stop_[k] * v_(k) > 0.0 && !is_at_rest(k); }
  bool was_reflected(int k) const;  // by its stop, with the speed that restitution requires
  void record(double t, int k, JointTransition::Kind kind, int direction) {
    joints_.transitions.push_back({t, k, kind, direction});
  }

  System& system_;
  Core& core_;
  Joints& joints_;
  const double min_rise_;
  const Tolerance& tolerance_;
  bool was_decided_ = false;  // whether modes have been determined since the start
  Vector v_, a_, held_acceleration_, rest_speed_, step_;
  Indices nearby_stop_;                 // (n): side of the stop that a joint is at, as `stop_side`
  std::vector<JointArrival> arrivals_;  // joints that have arrived in their new mode at this instant
  bool holding_was_exceeded_ = false;   // whether a holding force was exceeded
  Matrix responses_, A_;
  Vector b_, low_, high_, scale_, x_, rounding_;
};

}  // namespace ckc
