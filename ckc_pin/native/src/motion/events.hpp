// Events: zero crossings of functions of the state, located within the step that contains them.
//
// A function is evaluated at Chebyshev points of a step, and at the extrema of the polynomial through them, because
// it may cross zero and return in between. If an extremum is close to zero, the minimum of the function's magnitude
// is searched, which finds kinks as well. Coordinates and rates are evaluated only if the values at the ends of the
// step do not exclude a crossing.
#pragma once

#include <functional>
#include <vector>

#include <Eigen/SVD>

#include "motion/method.hpp"

namespace ckc {

struct Event {
  enum Quantity { q, q_dot, sigma_min_phi_z, sigma_min_J, function, holding_margin };
  Quantity quantity;
  int coordinate = 0;
  double value = 0.0, sign = 1.0;  // the event's function is sign * (quantity - value)
  int direction = 0;               // 1: rising, -1: falling, 0: both
  bool stop = false;               // whether it stops the loop
  bool switches_joints = false;    // whether a prescribed joint begins or ends to move there
  double zero_threshold = 0.0;     // smaller values count as zero
  // Evaluate a user's function at (t, state of the core). False if it raised an exception.
  std::function<bool(double, System&, double&)> evaluate;
  // Not a user's event: a joint comes to rest, reaches a stop, or exceeds its holding force.
  bool is_joint_event = false;
};

struct EventOccurrence {
  double t;
  int event, direction;
};

// Error of a function that is due to the solver's tolerances, relative to its largest value.
constexpr double relative_zero_tolerance = 1e-7;
// Rounding of a function while joints are at rest, relative to max(1, largest value).
constexpr double function_rounding = 1e-12;

using Points = std::vector<std::pair<double, double>>;  // (t, value), sorted by t

using ScalarFunction = std::function<bool(double, double&)>;

constexpr int sample_degree = 8;
const Vector& sample_points();  // relative to the step, from 0 to 1

struct Interval {
  double from, to;
  double at(double fraction) const { return from + (to - from) * fraction; }
};

// Finds the sign changes of a function within a step. The object keeps the results, and reuses its workspace.
struct RootSearch {
  std::vector<std::pair<double, int>> sign_changes;  // (t, direction), sorted
  int sign = 0;                                      // last nonzero sign, 0 if there was none
  bool on_zero = false;                              // whether the function is zero at the end of the step
  bool always_on_zero = false;                       // whether it is zero throughout the step

  // `values`: at the sample points. `sign_before`: before the step. `zero_threshold`: smaller values count as zero.
  // `exact`: the exact function, if `function` is a cheap approximation. False if the function has no value somewhere.
  bool find(const ScalarFunction& function, Interval step, In values, int sign_before, double zero_threshold,
            const ScalarFunction* exact = nullptr);

 private:
  bool add_extrema(const ScalarFunction& function, Interval step, In values, double zero);
  Points points_, kinks_;
  Vector fine_values_, exact_values_;
};

class Events {
 public:
  Events(System& system, Step& step, std::vector<Event> events);

  void reset();       // at the start of a motion
  void restart();     // the motion continues from another state than the last step's end
  void start_step();  // the core is at the start of the step, as the right-hand side left it
  void end_step();    // the core is at the end of the step, as the right-hand side left it
  // Locate events in the last step. `stop_time`: first event that stops the loop, else infinite. `last`: the motion
  // ends with this step. `joints_only`: ignore the user's events. False if a function has no value: `failed`, or the
  // control's failure, tells which.
  bool find_events(Interpolant& motion, bool last, bool joints_only, double& stop_time);
  // Determine the sign of each event that has none yet, at (t, y), before a transition of joint modes. A jump across
  // the value can then be detected. False if a function has no value.
  bool determine_signs_before_transition(double t, In y);
  // Monitor the joints in their present modes, starting from these coordinates and velocities. `time_tolerance`: of the
  // present time, s.
  void monitor_joints(In coordinates, In velocity, double time_tolerance);

  std::vector<EventOccurrence> occurrences;
  std::vector<Event> joint_events;  // joint events that triggered the last stop
  int failed = -1;                  // event whose function has no finite value, else -1
  double failed_value = 0.0;
  bool is_empty() const { return events_.empty(); }
  bool stopped() const { return stopped_; }  // whether the last stop was due to a user's event
  Indices switching;  // events of the last stop at which prescribed joints may begin or end

 private:
  struct End {  // state at an end of the step, as the right-hand side left it
    Vector q, v, a;
    bool has_acceleration = false;
  };
  // How accurately the core represents y_. `joints_at_rest`: projected, with locked joints exactly at rest.
  enum CoreAccuracy { not_set, unprojected, projected, joints_at_rest };
  bool continues_on_same_side(int k) const;
  bool is_excluded(const Event& event) const;
  bool joints_clearly_held(int k);
  // Value of an event at y_. Coordinates and rates are read from y if possible; holding forces use the unprojected
  // state.
  bool event_value(int k, double t, double& value);
  bool exact_value(int k, double t, double& value);
  bool value_at_core(int k, double t, double& value);  // the core is at y_
  bool set_state(Interpolant& motion, double t);
  bool set_core(double t, CoreAccuracy required);  // to y_
  void record_end(End& end, In f);
  double holding_margin() const;  // at the last evaluated right-hand side
  bool sample_values(Interpolant& motion, Eigen::Index first, Eigen::Index stride);
  bool joints_hold_throughout(int k) const;  // decided by every second sample point
  bool search_step(Interpolant& motion, bool last, double& stop_time);
  void report_occurrences(double stop_time);
  void add_joint_events();

  // --- joints at rest (events_at_rest.cpp) ---
  //
  // Whether a locked joint holds the event's coordinate.
  bool is_held(const Event& event) const;
  double held_value(const Event& event) const;
  // Whether the event's sign changed at the start of this step.
  bool has_just_crossed(int k) const;
  // Set the sign of an event from the start of this step on. If its previous sign was different, the event occurs
  // there.
  void report_arrival(int k, int sign, double& stop_time);
  // Whether the event's function stays on its value throughout the step. Crossings found in it are then rounding.
  bool stays_on_value(int k);
  bool is_still(int k) const;
  bool can_move(int coordinate, double t, In y);  // given the loops and the joints at rest

  System& system_;
  Step& step_;
  std::vector<Event> events_;
  std::vector<int> signs_;       // by event: last nonzero sign of its function, 0 if unknown
  std::vector<char> active_;     // by event: whether it can occur in the present joint modes
  Indices to_search_, sampled_;  // events to search in this step; events whose values were sampled
  const Vector& sample_points_;
  End start_, end_;
  std::vector<double> crossed_at_;      // by event: time of its last sign change, s; NaN if there is none
  std::vector<double> largest_;         // by event: largest |value| in this motion
  std::vector<char> resting_;           // by event: whether it has reached its value and stayed there
  bool joints_changed_ = false;         // whether joint modes changed at the start of the next step
  double change_time_tolerance_ = 0.0;  // s, of the time of that transition
  bool stopped_ = false;
  bool start_is_known_ = false;                   // whether start_ belongs to this step
  double end_holding_margin_ = 0.0;               // at the end of the step, NaN if unknown
  double last_values_time_ = 0.0;                 // s, end of the last step
  std::vector<double> last_values_;               // by event: value at that time, NaN if not evaluated
  Matrix values_;                                 // (sample points, events)
  std::vector<RootSearch> searches_;              // by event
  std::vector<EventOccurrence> new_occurrences_;  // in this step
  Vector y_, coordinates_;
  CoreAccuracy core_accuracy_ = not_set;  // at y_
  Eigen::JacobiSVD<Matrix> svd_J_, svd_phi_z_;
  Matrix phi_z_, responses_;
};

}  // namespace ckc
