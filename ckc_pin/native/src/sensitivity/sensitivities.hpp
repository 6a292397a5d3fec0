// First-order sensitivities of a motion with respect to parameters: the variational equations of eq. 1 in tangent
// coordinates.
//
// One column per parameter, (tangent step of q', change of v'). The equations hold for every formulation, since all
// describe one motion. Derivatives with respect to lengths, angles and placements are those along additional locked
// joints, which a second tree contains. If the terms are compiled with directional derivatives, a parameter is a
// direction in the space of the compiled terms' parameters.
#pragma once

#include <deque>
#include <optional>

#include "motion/system.hpp"

namespace ckc {

// One partial derivative through which a parameter acts. The contributions of a parameter add up.
struct ParameterDerivative {
  enum Kind {
    placement,  // index: coordinate of the extended tree; numbers: displacement along it (1)
    // index: joint of the extended tree; numbers: change of mass, first moment and inertia about the joint's origin
    // (10)
    inertia,
    gravity,  // numbers (3)
    stiffness,
    rest_length,
    damping,  // index: spring between frames
    joint_stiffness,
    joint_rest,
    joint_damping,
    constant,
    friction,
    restitution,
    lower,
    upper,     // index: coordinate
    armature,  // index: coordinate; numbers: change (1)
    length,    // index: row
    offset,    // index: row
    ratio,     // index: row; numbers: the other coordinate (1)
    gain_q,
    gain_q_dot,    // numbers: change of K_P or Lambda, of K_V or K_D, by columns
    target,        // index: component of q_d; numbers: column of K_P
    gear,          // index: motor; numbers: change of its transmission by coordinate (n)
    torque_limit,  // index: motor; numbers: its transmission by coordinate (n)
  };
  Kind kind;
  int index;
  Vector numbers;
};

struct SensitivityParameter {
  std::vector<ParameterDerivative> derivatives;
  Vector q, q_dot;   // (n), (d): initial sensitivities of the independent coordinates (tangent), and of their rates
  int assembled_at;  // coordinate whose stop defines the start and depends on the parameter; else -1
};

struct SensitivityTable {
  std::string model;                // the tree extended by locked joints
  Indices q_index, real_q, real_v;  // indices of the extended tree; where the mechanism's q' and coordinates are in it
  Closure closure;
  SpringTable springs;
  Indices fixed_q;  // q of the controller
  bool at_equilibrium;
  Vector target;  // q' at which the controller's compensation is computed, if it depends on parameters; else empty
  Matrix turns;   // (motors, n)
  Indices part;   // (n): number of the unconnected part of the mechanism, from 0
  std::vector<SensitivityParameter> parameters;
  Matrix directions;  // (parameters of the compiled terms, parameters); empty if they are not available
};

// An event that makes the motion not differentiable with respect to a parameter.
struct NonDifferentiableEvent {
  enum Reason {
    time,  // parameters shift it to a different time than the simultaneous events, or it does not occur for others
    restitution,        // joints that move only together are reflected by stops with different restitution
    marginally_locked,  // only rounding keeps the joint locked; for some parameter values it is released
  };
  JointArrival arrival;
  int parameter;
  Reason reason = time;
};

class Sensitivities {
 public:
  Sensitivities(System& system, SensitivityTable table);

  const int n, count;
  long compiled_evaluations = 0, general_evaluations = 0;  // number of evaluations by compiled terms and by Pinocchio's
  // Derivative of the time of an arrival with respect to each parameter, where the core moves with v and accelerates
  // with a.
  Vector time_shift(const JointArrival& arrival, In v, In a, const Matrix& s) const;
  // at the last joint transition
  Vector time_shift(int coordinate) const { return time_shift_.row(table_.part[coordinate]); }
  // Initialize s from the initial sensitivities of the independent coordinates. False if the start is singular.
  bool start(In v, Matrix& s);
  // Rates of s at the core's state with velocity v and acceleration a. False if the applied force has no known
  // derivatives.
  bool rates(In v, In a, const Matrix& s, Matrix& s_dot);
  // The same by compiled terms, at any state. False if they are not available or would lose digits.
  bool has_compiled_terms() const;
  bool compiled_rates(In q_tree, In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot);
  // Whether the last rates failed because a motor has gone from one limit to the other since the last accepted state.
  // A shorter step shows whether it passes through its range.
  bool at_torque_pole() const { return torque_pole_; }
  void accept();
  void record_column_sizes(const Eigen::Ref<const Matrix>& s);  // remember the largest norm of each column
  // Rates if all parameters act on the initial state only; takes the derivatives of eq. 1.
  void initial_state_rates(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const;
  // Sensitivities of eq. 6's force, (d, parameters), and of the motor torques, (motors, parameters), at the core's
  // state. NaN where unknown.
  void force_sensitivities(In v, const Matrix& s, Matrix& u, Matrix& tau);
  // Update the held sensitivities of the control after a sample at the core's state. `changed` tells whether s has to
  // be restarted, which may be so even if u is unchanged.
  bool control_sampled(const Matrix& s, const Sampling& clock, bool& changed);
  bool has_held_output() const { return held_output_.size() && !held_output_.isZero(0.0); }
  // Transitions of joint modes, called as those of Integrand. In between, s belongs to the parameter-dependent time of
  // the event. An impact may have several rounds, each starting at velocity v.
  bool before_transition(In v, In a, const std::vector<JointArrival>& arrivals, Matrix& s);
  bool at_impact(In v, In step, const Indices& at, const Matrix& responses, In x, double restitution, Matrix& s);
  bool project_sensitivities(In v, Matrix& s);
  // Find the first arrival whose time depends on a parameter differently than the event's time. Requires projected s.
  std::optional<NonDifferentiableEvent> find_non_differentiable(const std::vector<JointArrival>& arrivals,
                                                                const Matrix& s, double rtol, double atol);
  void after_transition(In v, In a, Matrix& s);
  // Find a joint that only rounding has kept locked since the last step, and a parameter that changes its force: for
  // a slightly different value the joint is released.
  std::optional<NonDifferentiableEvent> find_marginally_locked(double atol);

 private:
  void compute(In v, In a, In lambda, bool impulsive);  // derivatives_ of the extended tree
  // rates of the tangent steps of q'
  void configuration_rate_sensitivities(In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) const;
  void prepare_compiled();
  int torque_limit_side(int motor) const;  // of the limit that a motor is at: -1, 1, or 0 for none
  void direction(const Eigen::Ref<const Matrix>& s, int p, bool acts, Out to);
  bool compute_applied_force(In v);                      // and its derivatives if has_feedback_
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
  void solve_dependent(const Matrix& open, Matrix& x);
  void compute_balance(Matrix& q, Matrix& force_derivative, Matrix& stiffness);
  const Matrix& requested_u_derivative(In q_tree, In v);  // (d, parameters)
  // Subtract the derivative of the requested or held u from the rows of q.
  void add_requested_u(In q_tree, In v, Matrix& force);
  void limited_motor_sensitivities(In v);  // sets limited_tau_
  void add_state_derivatives(const Matrix& s);
  void add_tree_force(Out force) const;  // maps tree_force_ to the mechanism's coordinates
  Vector distance_from_stop_derivative(const JointArrival& arrival, const Matrix& s) const;  // by parameter
  bool has_defined_time(int coordinate, bool of_rate, In v, In a) const;  // it moves faster than rounding
  bool mode_changed(const JointArrival& arrival) const;           // since `before_transition`
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
  Matrix gear_force_;  // derivative of the motors' force through their transmissions
  // Parameters that the compiled code processes together, one row each.
  struct DirectionGroup {
    int first, count;
    Matrix directions, derivatives;
  };
  bool torque_pole_ = false;
  Indices torque_limit_side_;  // by motor, at the last accepted state: -1, 1, or 0 for none
  std::vector<DirectionGroup> direction_groups_;
  std::vector<Indices> parameter_groups_;  // by parameter: groups of the compiled terms' parameters
  struct Gain {
    int parameter;
    Matrix of_q, of_q_dot;  // change of K_P or Lambda, and of K_V or K_D
  };
  std::vector<Gain> gains_;
  std::deque<Matrix> queued_;  // sensitivities of samples that do not act yet
  Matrix held_output_;
  Vector applied_force_, locked_correction_, direction_, group_direction_, tree_force_, lambda_, residual_force_;
  Vector q_, v_, a_, fixed_q_, fixed_q_dot_, u_derivative_;
  Matrix time_shift_;                                // (parts, parameters)
  Vector largest_norm_;                              // by parameter: largest norm of its column so far
  bool before_first_transition_ = true;              // no joint transition has occurred yet
  Indices previous_direction_, previous_stop_side_;  // joint modes before the transition
  // By coordinate: what impacts should add to its rate but cannot, by parameter.
  std::vector<std::pair<int, Vector>> unreached_rates_;
  Matrix free_derivative_;                     // of the acceleration without holding forces, by parameter
  Matrix locked_force_derivative_;             // of the holding forces, by parameter
  std::vector<char> was_at_limit_;             // (n): joints that only rounding kept locked after the last step
  std::vector<char> was_locked_, was_struck_;  // (n): before the transition; by its impacts
};

}  // namespace ckc
