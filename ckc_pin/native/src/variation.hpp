// How a motion changes with parameters: the variational equations of eq. 1 in tangent coordinates, of first order.
//
// A column a parameter, (step of q', change of v'). They are the same in every formulation and in all coordinates, since
// those are of one motion. Of lengths and placements the derivatives are those along joints that are locked where the
// frame is, which a tree of its own has beside the mechanism's.
#pragma once

#include "system.hpp"

namespace ckc {

struct Parameter {
  enum Kind {
    start,         // of nothing but where it starts
    placement,     // index: of the tree's own coordinates
    inertia,       // index: joint of the tree; numbers: of mass, moment and inertia about the joint's origin (10)
    gravity,       // numbers (3)
    stiffness, rest_length, damping,  // index: spring between frames
    joint_stiffness, joint_rest, joint_damping, constant, friction, restitution, lower, upper,  // index: coordinate
    length,        // index: row
    offset,        // index: row
    gain_q, gain_q_dot,  // numbers: a change of K_P, K_V, columns; then q_d
  };
  Kind kind;
  int index;
  Vector numbers;
  Vector q, q_dot;  // (n), (d): how the start's independent coordinates, tangent, and their rates change with it
};

struct VariationTable {
  std::string model;  // with locked joints
  Indices place, real_q, real_v;  // of those, and where the mechanism's q' and coordinates are in it
  Closure closure;
  SpringTable springs;
  Indices own;  // q of what acts
  bool at_equilibrium;
  Vector target;  // q' where a controller compensates what this mechanism needs to stay, or none
  std::vector<Parameter> parameters;
};

class Variation {
 public:
  Variation(System& system, VariationTable table);

  const int n, count;
  // How much later with each parameter what is met there comes; false where two things come that do not come together.
  bool delays(In v, In a, const std::vector<System::Met>& met, const Matrix& s);
  const Vector& delay() const { return delay_; }
  // From a start in the independent coordinates; false where it is singular.
  bool start(In v, Matrix& s);
  // Of s at the core's state, where it moves with v and accelerates with a under what acts; false where what acts has no
  // known derivatives.
  bool rates(In v, In a, const Matrix& s, Matrix& s_dot);
  // The same where nothing varies but the start, by eq. 1's derivatives.
  void rates_of_start(In v, const Matrix& by_q, const Matrix& by_v, const Matrix& s, Matrix& s_dot) const;
  // Where joints change what they do.
  bool before_change(In v, In a, const std::vector<System::Met>& met, Matrix& s);
  bool at_impact(In step, const Indices& at, const Matrix& responses, In x, In back, Matrix& s);
  void after_change(In v, In a, Matrix& s);

 private:
  void compute(In v, In a, In lambda, bool impulsive);  // of the whole tree
  void move(In v, const Matrix& s, Matrix& s_dot) const;  // the places' part of the rates
  // What each parameter adds to the forces that are lacking, and to J a; `impulsive` as there.
  void add_parameters(In v, In lambda, bool impulsive, Matrix& force, Matrix& row) const;
  void add_inertia(const Parameter& of, bool impulsive, Out force) const;
  void add_gravity(const Parameter& of, Out force) const;
  void add_spring(const Parameter& of, Out force) const;
  void closure_changes(Matrix& place, Matrix& rate) const;
  void close(const Matrix& open, Matrix& x);
  void balance(Matrix& q, Matrix& effort, Matrix& stiffness);
  void add_gain(const Parameter& of, In v, Out force) const;
  void add_control(In v, Matrix& force) const;
  void add_state(const Matrix& s);
  void put(Out force, const Vector& of_tree) const;  // of the mechanism's coordinates

  System& system_;
  Core& core_;
  const VariationTable table_;
  Tree tree_;
  Derivatives derivatives_;
  Matrix u_by_q_, u_by_v_, force_, row_, change_, responses_, compensated_;
  Vector acting_, back_;
  Vector q_, v_, a_, delay_;
};

}  // namespace ckc
