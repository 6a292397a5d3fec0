// The step loop: the one place where time advances. It owns its state, and says why it stopped as a value.
#pragma once

#include <array>

#include "motion/crossing.hpp"
#include "motion/energy_monitor.hpp"
#include "motion/events.hpp"
#include "motion/explicit.hpp"
#include "motion/joint_mode_transitions.hpp"
#include "motion/radau.hpp"
#include "motion/recorder.hpp"

namespace ckc {

constexpr long unlimited = 1L << 62;

struct Options {
  std::string method;  // "auto", or one by name
  double rtol, atol, max_step, min_step;
  long max_rhs;        // `unlimited` where none is given
  double closed;       // rad or m: how far the loops may be open along a collocation step
};

struct Stop {
  enum Why {
    end,          // the time asked for is reached
    event,        // one that stops
    pause,        // the interpreter is to be let in
    rhs_budget,
    wall_budget,
    pace,         // the rest would take more right-hand sides than anyone waits for
    min_step,
    step,         // no step can be made: see `trouble`
    rank,         // J loses rank and that cannot be passed
    chart,        // q has stopped to determine z
    energy,       // a conservative motion's energy changes, however short the step
    control,      // a controller has no u
    function,     // an event's function has no finite value
    output,       // the state has no terms
    chatter,      // joints change their mode again and again at one instant
    contact,      // no contact forces or impulses are found there
    beyond_stop,  // a joint has passed its stop: `which`
    raised,       // a caller's function did
  } why;
  double t = 0.0, value = 0.0;  // when; least singular value, right-hand sides, or what a function gave
  int which = -1;               // whose function, or which coordinate
};

class Loop {
 public:
  Loop(std::unique_ptr<Control> control, std::unique_ptr<System> system, Options options, std::vector<Event> events);

  // Begin at t from a configuration closed on phi = w, moving with v'; what was before has no influence.
  void start(double t, In q_tree, In v_tree, In w);
  void record(Vector instants, double* rows, Eigen::Index most) { recorder.begin(std::move(instants), rows, most); }
  // Let a u act from now on, constant; or torques of the motors.
  void hold(In u, bool of_motors);
  // Go on to a time. `final`: the motion ends there; seconds to the next pause, and to the end of the budget.
  // Where it does not end, and nothing has changed for some advances, a step may reach beyond; the present state is
  // then within it, and the step is made again from there should something change.
  Stop advance(double until, bool final, double pause, double budget);
  // The present state.
  double t() const { return beyond_ ? t_present_ : now.t; }
  const Vector& y() const { return beyond_ ? y_present_ : now.y; }
  // Record it, unless that instant is recorded already.
  bool record_now();
  // The core there, closed, with the system's velocity and w; false where that does not exist.
  bool settle_core() { return system->exact(t(), y()); }

  const std::unique_ptr<Control> control;
  const std::unique_ptr<System> system;
  Step now;
  Work work;
  Recorder recorder;
  Events events;
  std::array<long, 3> steps{};  // by method: DOP853, RK45, Radau
  std::vector<double> crossings;  // when J lost rank
  const Method* method() const { return method_; }
  double& newton_tolerance() { return tolerance_.newton; }
  // Right-hand sides after which `advance` pauses, whatever the time.
  long pause_at = std::numeric_limits<long>::max();

 private:
  // A step that was made: how it moves, when J lost rank on it (NaN for an ordinary one), and what is known at its end.
  struct Made {
    Interpolant* motion;
    double met;
    RankMonitor::Rank after;
    double margin;
  };
  std::optional<Stop> begin(double bound);
  std::optional<Stop> one_step(double bound, bool last);
  std::optional<Stop> ordinary(double bound, bool last);
  std::optional<Stop> across(double met, double left, double bound, bool last);
  // Keep a step, unless it goes beyond the time asked for: then it waits.
  std::optional<Stop> made(const Made& step, double bound, bool last);
  std::optional<Stop> finish(const Made& step, double bound, bool last);
  std::optional<Stop> keep(const Made& step, bool last);
  std::optional<Stop> check_stiffness(double bound);
  std::optional<Stop> keep_pace(double until);
  Stop within(double until);  // the step that goes beyond
  void back();                // from it to the present state
  std::optional<Stop> look(Interpolant& motion, bool last, double& halt);
  Stop event_failure();
  std::optional<Stop> outputs(Interpolant& motion, double until);
  std::optional<Stop> redo();
  int number() const { return method_ == &dop853_ ? 0 : method_ == &rk45_ ? 1 : 2; }  // of the method
  std::optional<Stop> sample();
  Stop trouble();
  Stop unknown();
  void jump();
  // Which joints slide, stick and touch from the present state on.
  std::optional<Stop> change_joints();
  void begin_joints();
  // At the end of a step that was kept.
  std::optional<Stop> keep_joints();
  void choose(double bound);      // a method, at the start
  void choose_again(double bound);  // of the explicit ones, for another segment
  double lasts(double bound) const;  // s: the motion's present piece
  bool is_stiff(double bound);
  void take(Method& method);
  void take_implicit();

  const Options options_;
  Tolerance tolerance_;
  Explicit dop853_, rk45_;
  std::unique_ptr<Radau> radau_;
  Method* method_ = nullptr;
  RankMonitor monitor_;
  EnergyMonitor energy_;
  Crossing crossing_;
  JointChanges joint_changes_;
  RankMonitor::Rank end_;     // at the present state
  double length_ = 0.0;       // of the last step
  bool begun_ = false;        // whether the present state was accepted, and end_ is known
  bool f_known_ = false;
  bool joints_known_ = true;  // how they go on from the present state
  double joints_at_ = 0.0;    // when that was found last,
  long joints_often_ = 0;     // and how often within what events are located to
  bool jumped_ = false;       // something has changed since the start that a second try would not know
  bool silent_ = false;       // nothing is recorded, no event is looked for
  long kept_ = 0, check_at_ = 0; // steps since the start; at how many stiffness is checked again, 0 for never
  long paced_ = 0;            // right-hand sides when the pace was looked at last,
  double paced_at_ = 0.0;     // and where that was
  long restarts_ = 0;         // times that joints have changed since the start
  double last_instant_ = 0.0; // outputs up to there are of the present segment,
  double segment_ = 0.0;      // which ends there; the start, before the first one
  struct Begin {
    double t = 0.0;
    Vector q_tree, v_tree, w;
  } begin_;
  Vector y_out_;

  bool reaches_ = false;         // whether a step may go beyond the time asked for,
  std::optional<Made> beyond_;   // the one that does,
  double until_ = 0.0, t_present_ = 0.0;  // that time, and the present one within it
  Vector y_present_;
  long unchanged_ = 0;           // advances since something changed
};

}  // namespace ckc
