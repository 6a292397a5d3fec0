// Events: functions of the state that cross zero, located within the step that crosses.
//
// A function is known at Chebyshev points of a step. Between them it can still dip through zero and come back, so it is
// also evaluated at the extrema of the polynomial through those points; and where it comes near to zero there, the
// nearest point is searched for, which finds the tip of a kink as well. Coordinates and their rates are looked at only
// where what is known at the ends of a step does not rule a crossing out.
#pragma once

#include <functional>
#include <vector>

#include <Eigen/SVD>

#include "motion/method.hpp"

namespace ckc {

struct Event {
  enum Of { q, q_dot, sigma_min_phi_z, sigma_min_J, function, holding };
  Of of;
  int coordinate = 0;
  double value = 0.0, sign = 1.0;  // it crosses where sign (its function - value) crosses zero
  int direction = 0;               // 1: rising, -1: falling, 0: both
  bool stop = false;
  double floor = 0.0;              // what counts as zero
  // Of a caller's own: the value at (t, the core's state); false where it raised.
  std::function<bool(double, System&, double&)> call;
  // Of the loop's own: a joint comes to rest, reaches a stop, or what holds those at rest gives way.
  bool own = false;
};

struct Crossed {
  double t;
  int event, direction;
};

constexpr double zero_tolerance = 1e-7;      // of a function's largest value: the solver's tolerances may take it so far off zero
constexpr double function_rounding = 1e-12;  // absolute, or of its largest value: rounding of a function while joints are at rest

using Points = std::vector<std::pair<double, double>>;  // (t, value), increasing in t

// Sign changes of a function within a step, and what was needed to find them.
struct Walk {
  std::vector<std::pair<double, int>> found;  // (t, direction), in order
  int sign = 0;                               // at the end, or the last one it had; 0 while it has had none
  bool on_zero = false;                       // at the end
  bool always_on_zero = false;                // from one end to the other
  Points points, tips;
  Vector curve, exact_values;
};
using Gap = std::function<bool(double, double&)>;

constexpr int walk_degree = 8;
const Vector& walk_places();  // in the step, from 0 to 1
// `values`: at those places of [from, to]; `sign`: what it came with; `floor`: what counts as zero, beside rounding;
// `exact`: the function where `gap` is one that costs less and is off by little. False where the function has no value.
bool walk(const Gap& gap, double from, double to, In values, int sign, double floor, Walk& walked,
          const Gap* exact = nullptr);

class Events {
 public:
  Events(System& system, Step& step, std::vector<Event> events);

  void begin();  // a motion begins
  void jump();   // it goes on from a state that is not the last step's end
  void begun();  // the core is there, as the right-hand side left it
  void arrived();  // the core is where the step just made ends, as the right-hand side left it
  // Locate events in the step just made; `halt`: when the first one that stops happens, else infinite. `last`: the
  // motion ends with this step; `silent`: only the loop's own are looked for. False where a function has no value:
  // `failed` and the system's problem say which.
  bool check(Interpolant& motion, bool last, bool silent, double& halt);
  // Find the sign of each event that has had none, at (t, y), before joints change there: a jump over the value is seen by
  // that sign. False where a function has no value, as `check`.
  bool learn_signs_before_change(double t, In y);
  // Joints slide, stick and touch as they do from now on; where they are, and how they move. `within`: s, how closely the
  // time of that is known.
  void monitor_joints(In coordinates, In velocity, double within);

  std::vector<Crossed> met;
  std::vector<Event> changing;  // the loop's own that were met where the last check halted
  int failed = -1;
  double failed_value = 0.0;
  bool any() const { return !events_.empty(); }
  bool halted() const { return halted_; }  // whether one that is not the loop's own was what the last check halted at

 private:
  struct End {  // of a step: what is known there without interpolation
    Vector q, v, a;
    bool accelerated = false;
  };
  // How closed the loops are where an event is looked at; `at_rest`: and joints that stick or touch are exactly at rest.
  enum Closed { only_y, as_y_is, exactly, at_rest };
  bool goes_on(int k) const;
  bool ruled_out(const Event& event) const;
  bool holds_by_far(int k);
  // At y_: a coordinate or a rate from y alone where y shows it, what holds with the loops as open as y has them.
  bool value(int k, double t, double& gap);
  bool exact_value(int k, double t, double& gap);
  bool value_there(int k, double t, double& gap);  // the core being at y_
  bool at(Interpolant& motion, double t);
  bool place(double t, Closed wanted);  // the core at y_
  void take_end(End& end, In f);
  double holding() const;  // what holds, at the state that the right-hand side was evaluated at last
  bool sample(Interpolant& motion, Eigen::Index first, Eigen::Index stride);
  bool holds(int k) const;  // by the values at every second place
  bool find(Interpolant& motion, bool last, double& halt);
  void report(double halt);
  void add_own();

  // --- joints at rest (events_at_rest.cpp) ---
  // Whether a joint that sticks or touches holds the event's coordinate.
  bool is_held(const Event& event) const;
  double held_value(const Event& event) const;
  // Whether the event changed its sign at the time where the step begins.
  bool has_just_crossed(int k) const;
  // Give an event the sign that it has from the step's begin on. Where the sign before was another one, the event occurs there.
  void report_arrival(int k, int sign, double& halt);
  // Whether an event's function stays on its value throughout the step. If so, crossings that the walk found are rounding.
  bool stays_on_value(int k);
  bool is_still(int k) const;
  bool can_move(int coordinate, double t, In y);  // whether the loops and the joints at rest let a coordinate move

  System& system_;
  Step& step_;
  std::vector<Event> events_;
  std::vector<int> signs_, wanted_, sampled_;  // by event; those to look at, those with values
  std::vector<char> active_;
  const Vector& places_;
  End start_, end_;
  std::vector<double> crossed_at_;      // by event: when its sign changed last, s; NaN where it has not
  std::vector<double> largest_;         // by event: the largest value that was sampled in this motion
  std::vector<char> resting_;           // by event: whether it came to its value and stayed there
  bool joints_changed_ = false;         // joints changed at the time where the next step begins
  double change_time_tolerance_ = 0.0;  // s: how closely that time is known
  bool halted_ = false;
  bool known_ = false;        // whether start_ is that of the step
  double end_holds_ = 0.0;    // what holds at its end, NaN where that is not known
  double values_at_ = 0.0;    // when the last values were taken
  std::vector<double> last_;  // and what they are; NaN where they were not
  Matrix values_;             // (places, events)
  std::vector<Walk> walks_;   // by event
  std::vector<Crossed> found_;
  Vector y_, coordinates_;
  Closed closed_ = only_y;    // how the core is at y_
  Eigen::JacobiSVD<Matrix> svd_J_, svd_phi_z_;
  Matrix phi_z_, responses_;
};

}  // namespace ckc
