// First-order sensitivities of a motion with respect to parameters: the variational equations of eq. 1 in tangent
// coordinates.
//
// One column per parameter, (tangent step of q', change of v'). The equations hold for every formulation, since all
// describe one motion. Derivatives with respect to lengths, angles and placements are those along additional locked
// joints, which an extended tree contains. If the terms are compiled with directional derivatives, a parameter is a
// direction in the space of the compiled terms' parameters.
#pragma once

#include <deque>
#include <optional>

#include "motion/system.hpp"

namespace ckc {

// One term of the derivative of the equations of motion with respect to a parameter; the terms add up. `numbers` are
// derivatives with respect to the parameter. Terms without `numbers` have the derivative 1.
struct ParameterDerivative {
  enum Kind {
    placement,  // index: coordinate of the extended tree; numbers: displacement along it (1)
    inertia,    // index: joint of the extended tree; numbers: mass, first moment, inertia about the joint's origin (10)
    gravity,    // numbers: gravity (3)
    // index: spring between frames
    stiffness,
    rest_length,
    damping,
    // index: coordinate
    joint_stiffness,
    joint_rest,
    joint_damping,
    constant,
    friction,
    restitution,
    lower,
    upper,
    armature,  // numbers: armature (1)
    rotors,    // numbers: row of the matrix that rotors of motors on several joints add to D' (n)
    // index: row of phi
    length,
    offset,
    coefficient,  // of an affine row; numbers: index of the coordinate, and the derivative of its coefficient (2)

    gain_q,        // index: unused; numbers: K_P or Lambda, by columns
    gain_q_dot,    // index: unused; numbers: K_V or K_D, by columns
    target,        // index: component of q_d; numbers: column of K_P
    gear,          // index: motor; numbers: its transmission by coordinate (n)
    torque_limit,  // index: motor; numbers: derivatives of its lower and its upper limit (2)
  };
  Kind kind;
  int index;
  Vector numbers;
};

struct SensitivityParameter {
  std::vector<ParameterDerivative> derivatives;
  Vector q;          // (n): initial sensitivities of the independent coordinates (tangent)
  Vector q_dot;      // (d): and of their rates
  int assembled_at;  // coordinate whose stop defines the start and depends on the parameter; else -1
};

struct SensitivityTable {
  std::string model;       // the tree extended by locked joints
  Indices q_index;         // of the extended tree
  Indices real_q, real_v;  // indices of the mechanism's q' and coordinates in the extended tree
  Closure closure;
  SpringTable springs;
  Indices fixed_q;  // q of the controller
  bool at_equilibrium;
  Vector target;  // q' at which the controller's compensation is computed, if it depends on parameters; else empty
  Matrix transmission;  // (motors, n)
  Indices part;         // (n): number of the unconnected part of the mechanism, from 0
  std::vector<SensitivityParameter> parameters;
  Matrix directions;  // (parameters of the compiled terms, parameters); empty if they are not available
};

// An event that makes the motion not differentiable with respect to a parameter.
struct NonDifferentiableEvent {
  enum Reason {
    time,               // the parameter separates it from simultaneous events, or it occurs on one side only
    restitution,        // joints that move only together are reflected by stops with different restitution
    marginally_locked,  // only rounding keeps the joint locked; on one side of the parameter's value it is released
  };
  JointArrival arrival;
  int parameter;
  Reason reason = time;
};

class Sensitivities {
 public:
  Sensitivities(System& system, SensitivityTable table);

  const int n, count;
  long compiled_evaluations = 0, general_evaluations = 0;  // of the rates, by compiled terms and by Pinocchio's
  // Derivative of the time of an arrival with respect to each parameter, where the core moves with v and accelerates
  // with a.
  Vector time_shift(const JointArrival& arrival, In v, In a, const Matrix& s) const;
  // Derivative of the time of the last joint transition, in the part of the mechanism that contains the coordinate.
  Vector time_shift(int coordinate) const { return time_shift_.row(table_.part[coordinate]); }
  // Initialize s from the initial sensitivities of the independent coordinates. False if the start is singular.
  bool start(In v, Matrix& s);
  // Rates of s at the core's state with velocity v and acceleration a. False if the applied force has no known
  // derivatives.
  bool rates(In v, In a, const Matrix& s, Matrix& s_dot);
  // The same by compiled terms, at any state. False if their elimination would lose digits.
  bool has_compiled_terms() const;
  bool compiled_rates(In q_tree, In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot);
  // Whether the last rates failed because a motor has gone from one limit to the other since the last accepted state. A
  // shorter step may find it within its limits.
  bool at_torque_pole() const { return torque_pole_; }
  void accept();
  void record_column_sizes(const Eigen::Ref<const Matrix>& s);  // remember the largest norm of each column
  // Rates if all parameters act on the initial state only; takes the derivatives of eq. 1.
  void initial_state_rates(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const;
  // Sensitivities of eq. 6's force, (d, parameters), and of the motor torques, (motors, parameters), at the core's
  // state. NaN where unknown.
  void force_sensitivities(In v, const Matrix& s, Matrix& u, Matrix& tau);
  // Update the sensitivities of held outputs after a sample at the core's state. `changed` is set if they change, even
  // if u itself is unchanged.
  bool control_sampled(const Matrix& s, const Sampling& clock, bool& changed);
  bool has_held_output() const { return held_output_.size() && !held_output_.isZero(0.0); }
  // Transitions of joint modes, see `Integrand`. Between before_transition and after_transition, s belongs to the
  // parameter-dependent time of the event. An impact may have several rounds, each starting at velocity v.
  bool before_transition(In v, In a, const std::vector<JointArrival>& arrivals, Matrix& s);
  bool at_impact(In v, In step, const Indices& at, const Matrix& responses, In x, double restitution, Matrix& s);
  bool project_sensitivities(In v, Matrix& s);
  // Find the first arrival whose time depends on a parameter in another way than the event's time. Requires a
  // projected s.
  std::optional<NonDifferentiableEvent> find_non_differentiable(const std::vector<JointArrival>& arrivals,
                                                                const Matrix& s, double rtol, double atol);
  void after_transition(In v, In a, Matrix& s);
  // Find a joint that only rounding has kept locked since the last step, and a parameter on which its force depends: a
  // small step of the parameter releases the joint.
  std::optional<NonDifferentiableEvent> find_marginally_locked(double atol);

 private:
  void compute(In v, In a, In lambda, bool impulsive);  // sets derivatives_, of the extended tree
  // Set the rates of the sensitivities of q'.
  void configuration_rate_sensitivities(In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) const;
  void prepare_compiled();
  int torque_limit_side(int motor) const;  // -1 or 1 if the motor is at a limit, else 0
  double limited_torque_derivative(const ParameterDerivative& of) const;  // of a torque_limit; 0 within the limits
  void assemble_direction(const Eigen::Ref<const Matrix>& s, int p, bool force_changes, Out direction);
  bool compute_applied_force(In v);                      // sets applied_force_, and its derivatives if has_feedback_
  void add_feedback(const Eigen::Ref<const Matrix>& s);  // to force_
  void add_locked_correction(Matrix& acceleration);      // of locked joints; sets locked_force_derivative_
  // Add the partial derivatives of the residual force and of J a. `impulsive`: for an impact.
  void add_parameters(In v, In a, In lambda, bool impulsive, Matrix& force, Matrix& row);
  void add_term_derivative(const ParameterDerivative& of, In a, In lambda, bool impulsive, Out force, Out row);
  void add_force_derivative(const ParameterDerivative& of, In v, Out force);
  void add_applied_derivatives(In q_tree, In v, Matrix& force);  // friction, motors and controllers
  void add_control_derivatives(In q_tree, In v, Matrix& force);  // motors and controllers only
  void add_inertia(const ParameterDerivative& of, bool impulsive, Out force);
  void add_gravity(const ParameterDerivative& of, Out force);
  void add_spring(const ParameterDerivative& of, Out force);
  void closure_derivatives(In v, Matrix& phi_derivative, Matrix& phi_dot_derivative) const;
  void solve_dependent(const Matrix& residuals, Matrix& x);
  void compute_balance(Matrix& q, Matrix& force_derivative, Matrix& stiffness);
  const Matrix& requested_u_derivative(In q_tree, In v);  // with respect to the parameters, at a fixed state
  // Subtract the derivative of the requested or held u from the rows of q.
  void add_requested_u(In q_tree, In v, Matrix& force);
  void limited_motor_sensitivities(In v);  // sets limited_tau_
  void add_state_derivatives(const Matrix& s);
  void add_tree_force(Out force) const;  // adds the mechanism's coordinates of tree_force_
  Vector distance_from_stop_derivative(const JointArrival& arrival, const Matrix& s) const;  // by parameter
  // Whether the time of an arrival is defined: the coordinate, or its rate, changes faster than rounding.
  bool has_defined_time(int coordinate, bool of_rate, In v, In a) const;
  bool mode_changed(const JointArrival& arrival) const;  // since `before_transition`
  void shift_time(In v, In a, double sign, Matrix& s) const;
  double column_norm(const Eigen::Ref<const Matrix>& s, int p) const;  // in units of the joints' reach

  System& system_;
  Core& core_;
  const SensitivityTable table_;
  Tree tree_;
  DynamicsDerivatives derivatives_;
  bool has_applied_derivatives_ = false;  // some parameter acts through friction, motors or controllers
  bool has_feedback_ = false;             // the applied force depends on the state
  Matrix u_by_q_, u_by_v_, force_, row_, derivative_, responses_, compensation_, limited_tau_, requested_u_;
  Matrix gear_force_;  // derivative of the motors' force with respect to their transmissions, by parameter
  // Parameters that the compiled code processes together, one row each.
  struct DirectionGroup {
    int first, count;
    Matrix directions, derivatives;
  };
  bool torque_pole_ = false;   // see at_torque_pole
  Indices torque_limit_side_;  // by motor, at the last accepted state
  std::vector<DirectionGroup> direction_groups_;
  std::vector<Indices> parameter_groups_;  // by parameter: groups of the compiled terms' parameters
  struct Gain {
    int parameter;
    Matrix of_q, of_q_dot;  // derivative of K_P or Lambda, and of K_V or K_D
  };
  std::vector<Gain> gains_;
  std::deque<Matrix> queued_;  // sensitivities of outputs that wait for their delay
  Matrix held_output_;         // sensitivities of the present output, (d, parameters); empty before the first
  Vector applied_force_, locked_correction_, direction_, group_direction_, tree_force_, lambda_, residual_force_;
  Vector q_, v_, a_, fixed_q_, fixed_q_dot_, u_derivative_;
  Matrix time_shift_;                                // (parts, parameters)
  Vector largest_norm_;                              // by parameter: largest norm of its column so far
  bool before_first_transition_ = true;              // no joint transition has occurred yet
  Indices previous_direction_, previous_stop_side_;  // joint modes before the transition
  // (coordinate, by parameter): part of its rate's sensitivity that impacts would have to add but cannot.
  std::vector<std::pair<int, Vector>> unreached_rates_;
  Matrix free_derivative_;                     // of the acceleration without holding forces, by parameter
  Matrix locked_force_derivative_;             // of the holding forces, by parameter
  std::vector<char> was_at_limit_;             // (n): joints that only rounding kept locked after the last step
  std::vector<char> was_locked_, was_struck_;  // (n): locked before the transition; struck by its impacts
};

}  // namespace ckc
