// A formulation of the equations of motion as a first-order system y' = f(t, y). The entries of y are those of the motion,
// the state of the control law, the works if they are integrated, and an integrand, if there is one.
#pragma once

#include "control/control.hpp"
#include "control/forces.hpp"
#include "loops/elimination_check.hpp"
#include "loops/spectrum.hpp"
#include "motion/integrand.hpp"

namespace ckc {

// Smallest singular value of phi_z over |J| at which q is no longer a valid chart.
constexpr double chart_margin = 1e-5;

struct Counts {
  long newton = 0, factorizations = 0;
  long switches = 0;     // changes of the partition
  long differences = 0;  // Jacobians by finite differences
  long general_rhs = 0;  // right-hand sides for which the compiled elimination was not accurate enough
};

// Why a right-hand side does not exist.
enum class RhsFailure {
  none,
  loops_open,  // the projection onto the constraint manifold failed
  rank_lost,   // J has lost rank
  not_finite,
  no_control,                     // the controller has no u
  z_inaccurate,                   // z does not agree with its rates within the tolerance
  allocation_not_differentiable,  // the allocation among redundant motors at their limits has no known derivative
  torque_pole,                    // a motor jumps from one limit to the other: its requested torque has a pole
};

// Result of accepting a state.
enum class Accepted {
  unchanged,
  changed,    // y has changed but describes the same motion
  restarted,  // y has new coordinates; the history of steps is invalid
  rejected,   // the coordinates are singular here
};

// A joint whose motion is prescribed. It is a constraint row, joint - motion(t) = 0, and its multiplier is the torque of
// the motor on that joint. Before it begins and after it ends, the joint moves freely: the row then follows the joint,
// whose position and rate are entries of y, with the acceleration at which the multiplier is zero.
struct PrescribedJoint {
  struct Switch {
    double time;     // s, infinite if there is none
    Indices events;  // one of them
    bool exists() const { return !events.empty() || std::isfinite(time); }
    bool is_due(double t, const Indices& occurred) const;
  };
  int coordinate, row, motor;
  double offset;    // of the row: position at which its residual is zero
  double gear;      // shaft rate by joint rate of the motor
  double friction;  // of the joint; the motor overcomes it
  std::unique_ptr<Trajectory> motion;
  Vector corners;  // times at which a derivative of the motion jumps
  Switch begins, ends;

  bool can_be_free() const { return begins.exists() || ends.exists(); }
  bool is_free = false, has_ended = false;
  double from = 0.0, shift = 0.0;  // position = shift + motion(t - from)
  double position = 0.0, rate = 0.0, acceleration = 0.0;
};

// Instants at which functions of time (desired and prescribed motions, forces) or their derivatives jump. Steps end at
// them.
struct Breakpoints {
  Vector times;            // increasing
  double tolerance = 0.0;  // s: times closer than this coincide
};

// Works since the start, J.
enum class WorkOf { motors, dampers, friction, forces };
constexpr int work_count = 4;

class CompiledTerms;

class System {
 public:
  System(Core& core, Control& control, int motion_size);
  virtual ~System() = default;
  // Append an integrand to y. It must outlive this system.
  void append(Integrand& integrand);
  void integrate_works();
  // Entries of y before an integrand's.
  int coupled_size() const { return motion_size + law_size_ + free_size_ + work_size_; }
  bool integrates_works() const { return work_size_ > 0; }
  auto works(In y) const { return y.segment(motion_size + law_size_ + free_size_, work_size_); }
  // Set the entries of y behind the motion's at the start.
  void start_appended(Out y);
  void prescribe(std::vector<PrescribedJoint> joints);
  // Set the prescribed joints to the start of a motion.
  void start_prescribed_joints(In q_tree, In v_tree);
  // Begin and end the motions of prescribed joints that are due at t, or at one of these events. A rate that jumps
  // where a motion begins is caused by an impulse of the joint's motor. False if that fails.
  bool switch_prescribed_joints(double t, Out y, const Indices& events);
  void set_forces(std::unique_ptr<BodyForces> forces) { forces_ = std::move(forces); }
  BodyForces* forces() const { return forces_.get(); }
  void set_breakpoints(Breakpoints breakpoints) { breakpoints_ = fixed_breakpoints_ = std::move(breakpoints); }
  double next_breakpoint() const;
  double breakpoint_tolerance() const { return breakpoints_.tolerance; }
  // Begin the segment of smooth functions of time that contains t or begins there, up to the tolerance.
  void start_segment(double t);
  const std::vector<PrescribedJoint>& prescribed_joints() const { return prescribed_; }
  long row_version() const { return row_version_; }  // incremented when the motion of rows changes
  // Replace the torques of the motors on prescribed joints by those that make them move as prescribed, at the core's
  // state with its control. False if there is no acceleration.
  bool set_prescribed_torques(double t, Out tau);
  // Evaluate the prescribed motion of rows at t. Every function below that takes a time calls it. False, with a reason
  // in `control.failure`, if it is undefined.
  bool set_time(double t);

  // Start at t from a configuration with phi = w and velocity v' (rho q_dot, also off the manifold).
  virtual void start(double t, In q_tree, In v_tree, In w, Out y) = 0;
  // Compute y'. False if it does not exist or is not finite.
  bool rhs(double t, In y, Out y_dot);
  // Set the core and the members below to the state, projected as the formulation requires. False if that fails.
  bool sync_core(double t, In y) { return read_appended(y), sync_motion(t, y); }
  // The same without projection, if possible.
  bool sync_core_unprojected(double t, In y) { return read_appended(y), sync_motion_unprojected(t, y); }
  // Read a coordinate (or its rate) from y, unprojected. False if y does not contain it.
  virtual bool read_from_state(In /*y*/, int /*k*/, bool /*of_rate*/, double& /*value*/) const { return false; }
  // Write the projected state of the core, which belongs to y, into y.
  virtual void write_projected_state(Out) const {}
  // `sync_core` at the start of a motion.
  virtual bool sync_core_at_start(double t, In y) { return sync_core(t, y); }
  // `sync_core` at the state of the last right-hand side, without a new projection.
  bool sync_core_at_last_rhs(double t, In y) { return read_appended(y), sync_motion_at_last_rhs(t, y); }
  // Set the core to the configuration of y and compute J. False if y does not contain the configuration.
  virtual bool set_core_configuration(In) { return false; }
  // Distance of q from being a singular chart, at the core's state: smallest singular value of phi_z over |J|,
  // dimensionless. Infinite if the formulation needs no q.
  virtual double coordinate_margin() { return std::numeric_limits<double>::infinity(); }
  double phi_z_margin();
  Accepted accept_step(double t, Out y, double margin) { return read_appended(y), accept_motion(t, y, margin); }
  // Closure tolerance to which the next `accept_step` projects y = (q', v') by closing steps of the tree; zero if it does
  // something else.
  virtual double projection_tolerance() const { return 0.0; }
  // Return to the user's partition. False if its phi_z is singular.
  virtual bool restore_partition(double, Out, bool& changed) { return changed = false, true; }
  // Derivative of the coupled entries of y' with respect to those of y; that of the works is not computed and set to
  // zero, because nothing depends on them. Finite differences are counted in `evaluations`. False if it does not exist.
  bool jacobian(double t, In y, Matrix& jacobian, long& evaluations);
  // Pairs (i, j) of entries of y where the rate of y(i) is y(j).
  virtual void rate_pairs(std::vector<std::pair<int, int>>& of) const = 0;
  // Duration of a boundary layer at the start of the motion, s.
  virtual double boundary_layer_time() const { return std::numeric_limits<double>::infinity(); }
  // Whether the motion conserves its energy without control, friction and damping.
  virtual bool conserves_energy() const { return false; }
  // w_dot / w on a level set.
  virtual double w_decay_rate() const { return 0.0; }
  // Reduce a Jacobian at y to the part whose eigenvalues belong to the freedoms. False if that fails.
  virtual bool reduce_to_freedoms(In, Matrix&) { return true; }
  // `rhs` at y projected onto the constraint manifold to rounding, along all directions that J determines, however
  // weakly. False if the formulation cannot cross singular positions.
  virtual bool rate_on_manifold(double, In, Out) { return false; }
  // Configuration of the last right-hand side. Its velocity is `v_tree`.
  virtual const Vector& configuration_at_last_rhs() const { return core.q_tree; }
  // Compiled terms that alone give the rate of y = (q', v') from the applied force; null if the rate needs more.
  virtual const CompiledTerms* terms_of_rate() const { return nullptr; }
  bool has_applied_force() const { return control.is_active() || forces_ || core.joints.exerts_force(); }
  // The force applied to the tree where `terms_of_rate` gives the rate. False if there is none.
  virtual bool force_of_rate(double /*t*/, In /*q_tree*/, In /*v*/, Out /*force*/) { return false; }
  // Take y as the state of the last right-hand side, whose rate was computed elsewhere.
  virtual void set_last_rhs(In) {}
  // Move the core and `v_tree` to the state y of the last right-hand side, if compiled terms have left them elsewhere.
  virtual void move_core_to_last_rhs(In) {}
  // Acceleration of the tree at the last right-hand side. False if unknown.
  virtual bool tree_acceleration(In f, Out a) const = 0;
  // Called after a step was rejected because the full motion disagrees with its rates: forget all states since the
  // last accepted one, and project more exactly from there. False if that does not help any more.
  virtual bool return_to_accepted() { return true; }
  // Size of the full motion (q', v') if y is only a part that determines it, else zero.
  virtual int full_motion_size() const { return 0; }
  // Longest step over which the full motion's rates can be integrated, s.
  virtual double full_motion_max_step() const { return std::numeric_limits<double>::infinity(); }
  // The full motion and its rate at the last right-hand side, f = rhs(t, y).
  virtual void full_motion(In, Out, Out) const {}
  // Add the rounding errors of the full motion x to its error tolerances.
  virtual void add_rounding(In, Out) const {}

  // --- dry friction and stops ---
  //
  // Forces on the tree at velocity v: of the controller, and friction of sliding joints.
  const Vector& applied_force(In v);
  // Acceleration of the tree at the core's state, with holding forces on locked joints.
  bool acceleration(double t, Out a);
  // Compute the derivatives of that acceleration. The core must be at this state unless the terms are compiled and no
  // joint is locked. `correction` is added to J_dot v. False if the derivatives of the applied force are unknown.
  bool acceleration_derivatives(In q_tree, In v, In correction);
  bool acceleration_derivatives(In q_tree, In v) { return acceleration_derivatives(q_tree, v, row_correction_); }
  // The derivatives that were computed last, without by_u; null if finite differences have taken their place since.
  const AccelerationDerivatives* eq_1_derivatives() const { return eq_1_is_valid_ ? &eq_1_ : nullptr; }
  // Remove the drift of locked joints beyond `tolerance`, and their rates, from y, which is the core's state. False
  // if that fails.
  bool correct_locked_joints(Out y, double tolerance, bool& changed);
  // Add to the velocities, and to the coordinates, in y.
  void add_velocity(Out y, In v) const { add_motion_velocity(y, v), add_to_free_joints(y, v, 1); }
  void add_displacement(Out y, In step) const { add_motion_displacement(y, step), add_to_free_joints(y, step, 0); }
  // Continue from y, where the core is, with another velocity. The history of states is invalid.
  virtual void resume(double, Out) {}

  Core& core;
  Control& control;
  const int motion_size;  // number of entries of y that describe the motion, the first ones
  int size;               // number of all entries of y
  Integrand* integrand = nullptr;
  Counts counts;
  EliminationCheck elimination;
  bool crosses_singularities = false;  // whether collocation steps cross singular positions
  bool may_change_partition = false;   // whether accept_step may choose another q
  Vector velocity;                     // of the tree, (n)
  Vector v_tree;                       // velocity at which C is evaluated, (n)
  Vector w;                            // prescribed value of phi, (rows)
  Vector q, q_dot;                     // (d)

  RhsFailure failure = RhsFailure::none;  // of the last right-hand side

  // Evaluate control and forces at the core's state. False if one of them does not exist.
  bool compute_control(double t) {
    return (control.compute(measured(t)) && (!forces_ || forces_->compute(measured(t), control.failure))) ||
           fail(RhsFailure::no_control);
  }
  MeasuredState measured(double t) { return {t, core, q, q_dot, v_tree, q_dot}; }

 protected:
  virtual void add_motion_velocity(Out y, In v) const = 0;
  virtual void add_motion_displacement(Out y, In step) const = 0;
  virtual bool sync_motion(double t, In y) = 0;
  virtual bool sync_motion_at_last_rhs(double t, In y) = 0;
  virtual Accepted accept_motion(double t, Out y, double margin) = 0;
  virtual bool sync_motion_unprojected(double t, In y) { return sync_motion(t, y); }
  // Whether control or forces need the core at the state.
  bool force_needs_core() const { return control.needs_terms() || forces_ || law_size_; }
  // Called before and after finite differences.
  virtual void project_exactly(bool) {}
  // `rhs` and `jacobian` of the motion. All arguments have the motion's entries only. The default Jacobian uses finite
  // differences.
  virtual bool motion_rhs(double t, In y, Out y_dot) = 0;
  virtual bool motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations);

  bool fail(RhsFailure reason) { return failure = reason, false; }
  void partition_changed() { phi_z_singular_value_.reset(); }  // of the core
  // Eq. 1 at the core's state with velocity v, including holding forces. `correction` is added to J_dot v.
  bool acceleration_with_held_joints(In v, In correction, Out a);

  // J a = -(J_dot v + correction) of eq. 1: minus the prescribed acceleration of rows, (rows)
  Vector row_correction_;
  AccelerationDerivatives eq_1_;

 private:
  void read_appended(In y) {  // the state of the control law and of free joints
    if (law_size_) control.law->state = y.segment(motion_size, law_size_);
    if (free_size_) read_free_joints(y);
  }
  void read_free_joints(In y);
  void add_to_free_joints(Out y, In step, int at) const;  // at = 0: positions, 1: rates
  bool add_impulse(PrescribedJoint& joint, double rate_jump, Out y);
  void set_row(const PrescribedJoint& joint);
  void release_free_rows();
  bool coupled_rhs(double t, In y, Out y_dot);
  bool powers(double t, In y, Out power);
  bool difference_jacobian(double t, In y, Matrix& jacobian, long& evaluations);

  bool eq_1_is_valid_ = false;
  int law_size_ = 0, free_size_ = 0, work_size_ = 0;
  std::unique_ptr<BodyForces> forces_;
  Breakpoints breakpoints_, fixed_breakpoints_;  // the second without those of motions that begin in the run
  Eigen::Index passed_breakpoints_ = 0;
  Vector motor_torques_;
  std::unique_ptr<SmallestSingularValue> phi_z_singular_value_;
  std::vector<PrescribedJoint> prescribed_;
  Vector lambda_;
  double row_time_ = std::numeric_limits<double>::quiet_NaN();
  long row_version_ = 0;
  Vector moved_y_, moved_rate_, rate_at_y_, applied_force_, locked_drift_, locked_correction_, acceleration_;
  AppliedForce force_;
  Matrix responses_;
};

}  // namespace ckc
