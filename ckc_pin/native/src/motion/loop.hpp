// The step loop, the only place where time advances. It owns its state and returns the reason why it stopped.
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
  std::string method;  // "auto" or the name of a method
  double rtol, atol, max_step, min_step;
  long max_rhs;               // `unlimited` if there is no budget
  double manifold_tolerance;  // rad or m: largest |phi| along a collocation step
};

struct Stop {
  enum Reason {
    end,                   // the requested time is reached
    event,                 // a stopping event occurred
    pause,                 // the interpreter should run
    rhs_budget,            // the budget of right-hand sides is used up
    wall_budget,           // the budget of time is used up
    pace,                  // the remaining motion would take too many right-hand sides
    min_step,              // the step size fell below its minimum
    step,                  // no step can be made, see System::failure
    rank,                  // J loses rank, and the position cannot be crossed
    coordinates_singular,  // phi_z is singular: q does not determine z
    energy,                // the energy of a conservative motion changes, however short the step
    control,               // the controller has no u
    event_function,        // an event's function has no finite value
    output,                // the state cannot be recorded
    chatter,               // joint modes change again and again at one instant
    contact_unsolved,      // no contact forces or impulses exist
    beyond_stop,           // joint `which` has passed its stop
    exception,             // a callback raised an exception
  } reason;
  double t = 0.0;      // s
  double value = 0.0;  // smallest singular value, right-hand sides, energy change, or value of a function
  int which = -1;      // event or coordinate
};

class StepLoop {
 public:
  // `integrand`: null if nothing is integrated along with the motion.
  StepLoop(std::unique_ptr<Control> control, std::unique_ptr<System> system, std::unique_ptr<Integrand> integrand,
           Options options, std::vector<Event> events);

  // Start at t from a configuration with phi = w and velocity v'. Earlier runs do not influence the result.
  void start(double t, In q_tree, In v_tree, In w);
  void record(Vector instants, double* rows, Eigen::Index max_rows) {
    recorder.start(std::move(instants), rows, max_rows);
  }
  // Apply a constant u, or constant motor torques, from now on.
  void set_control(In u, bool of_motors);
  // Apply a constant wrench from now on. False if that force is no constant.
  bool set_wrench(size_t force, In wrench);
  // Move the controller's desired q to x until `end`, see Controller. False if it has none that can be replaced.
  bool move_desired(double end, In x);
  // Advance to a time. `final`: the motion ends there. `pause`, `budget`: seconds until the next pause and until the
  // end of the budget. A negative `pause`: before the first step and after each attempt of a step. A call with the
  // same `until` after a pause continues as if there had been none.
  //
  // If the motion does not end and neither control nor state have changed for several calls, the last step may end
  // beyond `until`. The present state is then inside that step, which is discarded at the next change.
  Stop advance(double until, bool final, double pause, double budget);
  // The next step, after the evaluations that precede it, except that of the rate. No method at the start and if another
  // method makes it.
  Explicit::Attempt prepare_explicit_step();
  // Present time and state.
  double t() const { return waiting_step_ ? t_present_ : now.t; }
  const Vector& y() const { return waiting_step_ ? y_present_ : now.y; }
  // Record the present state unless that instant is already recorded. False if it cannot be evaluated.
  bool record_now();
  // Set the core to the present state, projected. False if that fails.
  bool sync_core() { return system->sync_core(t(), y()); }

  const std::unique_ptr<Control> control;
  const std::unique_ptr<System> system;
  const std::unique_ptr<Integrand> integrand;
  Step now;
  Work work;
  Recorder recorder;
  Events events;
  std::array<long, 3> steps{};    // by method: DOP853, RK45, Radau
  std::vector<double> crossings;  // times at which J lost rank
  const Method* method() const { return method_; }
  double& newton_tolerance() { return tolerance_.newton; }
  // `advance` pauses after this many right-hand sides.
  long pause_at = std::numeric_limits<long>::max();

 private:
  struct CompletedStep {
    Interpolant* motion;
    double crossed_at;             // s, time at which J lost rank; NaN for an ordinary step
    RankMonitor::Rank after;       // at its end
    double margin;                 // `coordinate_margin` at its end
    bool end_is_computed = false;  // whether `computed_end_` is its end
  };
  std::optional<Stop> prepare_step(double bound);
  std::optional<Stop> make_step(double bound, bool last);
  std::optional<Stop> make_ordinary_step(double bound, bool last);
  std::optional<Stop> make_crossing_step(double crossed_at, double remaining, double bound, bool last);
  // Finish a step, or let it wait if it ends beyond the requested time.
  std::optional<Stop> submit_step(const CompletedStep& step, double bound, bool last);
  std::optional<Stop> finish_step(const CompletedStep& step, double bound, bool last);
  std::optional<Stop> accept_step(const CompletedStep& step, bool last);
  std::optional<Stop> check_stiffness(double bound);
  std::optional<Stop> check_pace(double until);
  Stop report_present(double until);  // inside the waiting step
  void start_state();                 // sets the state to `start_`
  Accepted accept_state(double t, Out y, double margin);
  bool can_take_computed_end() const;  // whether the ends of steps need nothing that `StepEnd` does not contain
  Accepted accept_computed_end();
  void return_to_present();  // discards the waiting step
  std::optional<Stop> find_events(Interpolant& motion, bool last, double& stop_time);
  Stop event_failure();
  std::optional<Stop> record_outputs(Interpolant& motion, double until);
  std::optional<Stop> repeat_with_finer_tolerance();
  int method_index() const { return method_ == &dop853_ ? 0 : method_ == &rk45_ ? 1 : 2; }  // as in `steps`
  std::optional<Stop> sample_control();
  Stop step_failure();
  Stop output_failure();
  void state_changed();  // the motion continues from another state or with another control
  // Decide which joints slide, stick and touch from the present state on.
  std::optional<Stop> update_joint_modes();
  void reset_joints();
  // Check the joints at the end of an accepted step.
  std::optional<Stop> check_joints();
  void choose_method(double bound);             // at the start
  void choose_explicit_method(double bound);    // for a new segment
  double segment_duration(double bound) const;  // s, expected
  bool motion_is_stiff(double bound);
  void use_method(Method& method);
  void use_implicit_method();

  const Options options_;
  Tolerance tolerance_;
  Explicit dop853_, rk45_;
  StepEnd computed_end_;  // of the next step, if Lanes has computed it
  std::unique_ptr<Radau> radau_;
  Method* method_ = nullptr;
  RankMonitor monitor_;
  EnergyMonitor energy_;
  Crossing crossing_;
  JointModeTransitions joint_transitions_;
  RankMonitor::Rank end_rank_;  // at the present state
  double last_step_size_ = 0.0;
  bool state_is_accepted_ = false;   // whether the present state was accepted; end_rank_ is then valid
  bool rate_is_known_ = false;       // whether now.f is the rate of the present state
  bool joint_modes_known_ = true;    // whether the joint modes are those of the motion from the present state on
  double joint_modes_time_ = 0.0;    // s, time of the last update of joint modes
  long transitions_at_instant_ = 0;  // updates of joint modes within the tolerance of that time
  bool cannot_repeat_ = false;       // control or state have changed since the start
  bool is_repeating_ = false;        // the run is being repeated: nothing is recorded, no user's event is reported
  long accepted_steps_ = 0;          // since the start, while stiffness is checked
  long next_stiffness_check_ = 0;    // number of steps at which stiffness is checked next; 0: never
  long pace_rhs_ = 0;                // right-hand sides at the last check of the pace
  double pace_time_ = 0.0;           // s, time of that check
  long joint_segments_ = 0;          // instants of joint transitions since the start
  double record_until_ = 0.0;        // s; outputs up to this time belong to the present segment
  double segment_end_ = 0.0;         // s, end of the present segment; before the first one, the start
  struct Start {
    double t = 0.0;
    Vector q_tree, v_tree, w;
  } start_;
  Vector y_out_;

  bool may_step_beyond_ = false;               // whether a step may end beyond the requested time
  std::optional<CompletedStep> waiting_step_;  // such a step
  double t_present_ = 0.0;                     // s, present time inside that step
  Vector y_present_;                           // state at that time
  double target_ = 0.0;                        // s, requested time
  long advances_unchanged_ = 0;  // calls of `advance` since the last change, without those that continue after a pause
  double reach_beyond_ = 0.0;    // s, how far a step may end beyond the requested time
  bool is_paused_ = false;       // whether `advance` returned for a pause, and nothing has changed since
};

}  // namespace ckc
