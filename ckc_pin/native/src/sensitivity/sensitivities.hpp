// How a motion changes with parameters: the variational equations of eq. 1 in tangent coordinates, of first order.
//
// A column a parameter, (step of q', change of v'). They are the same in every formulation and in all coordinates, since
// those are of one motion. Of lengths, angles and placements the derivatives are those along joints that are locked where
// the frame is, which a tree of its own has beside the mechanism's. Where the terms are written out with their changes, a
// parameter is a direction in the space of the numbers that the code takes.
#pragma once

#include <deque>
#include <optional>

#include "motion/system.hpp"

namespace ckc {

// One of the ways in which a parameter acts; they add up.
struct Effect {
  enum Kind {
    placement,     // index: of the tree's own coordinates; numbers: how far along it (1)
    inertia,       // index: joint of the tree; numbers: of mass, moment and inertia about the joint's origin (10)
    gravity,       // numbers (3)
    stiffness, rest_length, damping,  // index: spring between frames
    joint_stiffness, joint_rest, joint_damping, constant, friction, restitution, lower, upper,  // index: coordinate
    armature,      // index: coordinate; numbers: by how much (1)
    length,        // index: row
    offset,        // index: row
    ratio,         // index: row; numbers: the coordinate that it is of (1)
    gain_q, gain_q_dot,  // numbers: a change of K_P or Lambda, of K_V or K_D, columns
    target,        // index: of q_d; numbers: K_P's column
    gear,          // index: motor; numbers: of what it turns by coordinate (n)
    torque_limit,  // index: motor; numbers: what it turns by coordinate (n)
  };
  Kind kind;
  int index;
  Vector numbers;
};

struct Parameter {
  std::vector<Effect> effects;
  Vector q, q_dot;  // (n), (d): how the start's independent coordinates, tangent, and their rates change with it
  int assembled_at;  // coordinate: the start is assembled at its stop, which the parameter moves; else -1
};

struct VariationTable {
  std::string model;  // with locked joints
  Indices place, real_q, real_v;  // of those, and where the mechanism's q' and coordinates are in it
  Closure closure;
  SpringTable springs;
  Indices own;  // q of what acts
  bool at_equilibrium;
  Vector target;  // q' where a controller compensates what this mechanism needs to stay, or none
  Matrix turns;   // (motors, n)
  Indices part;   // (n): parts of the mechanism that nothing connects, from 0
  std::vector<Parameter> parameters;
  Matrix directions;  // (numbers that the written-out code takes, parameters); none where it does not take them
};

// A joint whose motion has no derivative with respect to a parameter.
struct Apart {
  enum Reason {
    time,         // it comes to what it does at another time than others, or not at all
    restitution,  // its stop throws it back together with joints that move only with it, by other restitutions
    let_go,       // only rounding keeps it locked, and on one side of the parameter's value it is not
  };
  System::Met met;
  int parameter;
  Reason reason = time;
};

class Variation {
 public:
  Variation(System& system, VariationTable table);

  const int n, count;
  long written = 0, general = 0;  // how often rates were found by the code that is written out, and by the tree
  // How much later with each parameter what is met comes, where the core moves with v and accelerates with a.
  Vector delay(const System::Met& met, In v, In a, const Matrix& s) const;
  Vector delay(int coordinate) const { return delay_.row(table_.part[coordinate]); }  // of the last change of joints
  // From a start in the independent coordinates; false where it is singular.
  bool start(In v, Matrix& s);
  // Of s at the core's state, where it moves with v and accelerates with a under what acts; false where what acts has no
  // known derivatives.
  bool rates(In v, In a, const Matrix& s, Matrix& s_dot);
  // The same at any state where the terms are written out with their changes; false where they are not, or lose digits.
  bool is_written() const;
  bool written_rates(In q_tree, In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot);
  // Whether rates were false because a motor has gone from its limit to the other one since the last state that was
  // accepted. A shorter step tells whether it is between them in between.
  bool at_pole() const { return at_pole_; }
  void accept();
  void measure(const Eigen::Ref<const Matrix>& s);  // remember how large each parameter's column has been
  // The same where nothing varies but the start, by eq. 1's derivatives.
  void rates_of_start(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const;
  // How eq. 6's force and the motors' torques change, (d, parameters) and (motors, parameters), at the core's state with
  // what acts there; NaN where that is not known.
  void efforts(In v, const Matrix& s, Matrix& u, Matrix& tau);
  // What a controller on a clock makes of s, where it has looked at the core's state; what acts is held until the next.
  // Whether that is another one now: s goes on otherwise then, even where u is what it was.
  bool sampled(const Matrix& s, const Sampling& clock, bool& changed);
  bool holds() const { return held_.size() && !held_.isZero(0.0); }
  // Where joints change what they do: as the system's. In between s is of the instant that comes with the parameters.
  // An impact may have several rounds, each with the velocity v that it begins with.
  bool before_change(In v, In a, const std::vector<System::Met>& met, Matrix& s);
  bool at_impact(In v, In step, const Indices& at, const Matrix& responses, In x, double restitution, Matrix& s);
  bool project_sensitivities(In v, Matrix& s);
  // The first arrival whose time depends on a parameter in another way than the instant's, for projected s; none if all agree.
  std::optional<Apart> apart(const std::vector<System::Met>& arrived, const Matrix& s, double rtol, double atol);
  void after_change(In v, In a, Matrix& s);
  // A joint that nothing but rounding keeps locked since the step before, at the state of the last rates, and a parameter
  // that changes the force on it: with a little more or less of it, the joint is let go. None if there is none.
  std::optional<Apart> let_go(double atol);

 private:
  void compute(In v, In a, In lambda, bool impulsive);  // of the whole tree
  void move(In v, const Eigen::Ref<const Matrix>& s, Eigen::Ref<Matrix> s_dot) const;  // the places' part of the rates
  void begin_written();
  int limit(int motor) const;  // that it is at, as in `limits_`
  void direction(const Eigen::Ref<const Matrix>& s, int p, bool acts, Out to);
  bool what_acts(In v);  // acting_, and its slopes where it answers_
  void add_answer(const Eigen::Ref<const Matrix>& s);  // to force_
  void add_back(Matrix& change);  // what holds the joints that are locked, with `back_forces_`
  // What each parameter adds to the forces that are lacking, and to J a; `impulsive` as there.
  void add_parameters(In v, In a, In lambda, bool impulsive, Matrix& force, Matrix& row);
  void add_effect(const Effect& of, In a, In lambda, bool impulsive, Out force, Out row);
  void add_force(const Effect& of, In v, Out force);
  void add_acting(In q_tree, In v, Matrix& force);  // of that the part of what acts
  void add_control(In q_tree, In v, Matrix& force);  // and of that the controller's and the motors'
  void add_inertia(const Effect& of, bool impulsive, Out force);
  void add_gravity(const Effect& of, Out force);
  void add_spring(const Effect& of, Out force);
  void closure_changes(In v, Matrix& place, Matrix& rate) const;
  void close(const Matrix& open, Matrix& x);
  void balance(Matrix& q, Matrix& effort, Matrix& stiffness);
  const Matrix& wanted(In q_tree, In v);  // how a controller's u changes with the parameters, (d, parameters)
  // The same, or what is held of it, with that sign, in the rows of q.
  void add_wanted(In q_tree, In v, Matrix& force);
  void clipped_efforts(In v);  // clipped_: how torques change with the parameters where motors are at limits
  void add_state(const Matrix& s);
  void put(Out force) const;  // of_tree_'s part of the mechanism's coordinates
  Vector from_stop(const System::Met& met, const Matrix& s) const;  // how far with each parameter a joint is
  bool is_known(int coordinate, bool of_rate, In v, In a) const;  // when it comes: it moves by more than rounding
  bool has_changed(const System::Met& met) const;  // whether a joint's mode has changed since `before_change`
  void add_delayed(In v, In a, double sign, Matrix& s) const;
  double size(const Eigen::Ref<const Matrix>& s, int p) const;  // of a column, by the joints' reach

  System& system_;
  Core& core_;
  const VariationTable table_;
  Tree tree_;
  Derivatives derivatives_;
  bool acting_varies_ = false;  // some effect is of what acts
  bool answers_ = false;        // what acts changes with the state
  Matrix u_by_q_, u_by_v_, force_, row_, change_, responses_, compensated_, clipped_, wanted_;
  Matrix geared_;  // of the motors' force with the gears alone
  struct Along {  // parameters that the code which is written out takes at a time, rows
    int first, count;
    Matrix directions, changes;
  };
  bool at_pole_ = false;
  Indices limits_;  // by motor: which it was at when a state was accepted last, -1, 1, or 0 for none
  std::vector<Along> along_;
  std::vector<Indices> groups_;  // by parameter, of the numbers that the code takes
  struct Gain {
    int parameter;
    Matrix of_q, of_q_dot;  // K_P's change, or Lambda's, and K_V's, or K_D's
  };
  std::vector<Gain> gains_;
  std::deque<Matrix> waiting_;  // of samples that do not act yet
  Matrix held_;
  Vector acting_, back_, direction_, of_group_, of_tree_, lambda_, lacking_;
  Vector q_, v_, a_, q_own_, q_dot_own_, more_;
  Matrix delay_;    // (parts, parameters)
  Vector largest_;  // by parameter: the size of its column so far
  bool begins_ = true;        // no change of joints was there yet
  Indices sign_, touch_;      // what joints did before the change
  std::vector<std::pair<int, Vector>> missed_;  // rates that impacts ask of a joint and cannot give it, by parameter
  Matrix free_, back_forces_;  // changes of accelerations without what holds joints, and of that, by parameter
  std::vector<char> at_limit_;  // (n): joints that only rounding kept locked at the end of the step before
  std::vector<char> locked_, struck_;  // (n): those that were held before it, those that impacts of it are at
};

}  // namespace ckc
