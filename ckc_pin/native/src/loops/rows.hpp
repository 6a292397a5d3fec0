// The constraint rows of the loop closures, and their Jacobian. They are built from the same primitives as in Python
// (`ckc_pin.mechanism.rows`): the step loop needs them without the interpreter.
//
// The derivative of every primitive is a sum over one to three joints of a wrench times the joint's Jacobian, J = sum
// of w . J_joint, both in world axes at the world's origin. J, J_dot and J_dot v then need one implementation each.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

struct Component {
  int out, pair, direction;
};
struct Dot {
  int out, a, b;
};
struct Distance {
  int out, pair;
  double length;
};
struct Affine {
  int out;
  Vector coefficients;
  double offset;
};
struct RelativeLog {
  int out[3];
  int joint_a, joint_b;
  Matrix3 rotation_a, rotation_b;
};

struct Closure {
  int rows;
  Indices point_joint, direction_joint;  // the points A of all pairs, then the points B
  std::vector<Vector3> point_local, direction_local;
  std::vector<Component> components;
  std::vector<Dot> dots;
  std::vector<Distance> distances;
  std::vector<Affine> affine;
  std::vector<RelativeLog> logs;
};

struct Wrench {
  int joint;
  Vector6 w, w_dot;
};

class ConstraintRows {
 public:
  ConstraintRows(const Tree& tree, Closure closure);

  Closure closure;
  std::vector<Indices> pattern;  // by row: columns of J that are not zero
  Vector phi;                    // (rows)
  Matrix J, J_dot;               // (rows, n); zero outside the pattern

  // Replace one kind of parameter: points concatenated; lengths, coefficients and offsets of all rows.
  enum class Parameter { point, length, affine, affine_offset };
  void set_parameters(Parameter what, In numbers);
  // the pattern restricted to `columns`, and numbered among them
  std::vector<Indices> pattern_in(const Indices& columns, int n) const;
  void update(const Tree& tree, In q);  // phi and the wrenches; requires the tree's placements
  void update_jacobian(const Tree& tree);
  void update_rates(const Tree& tree);  // rates of the wrenches; requires the tree's velocities and accelerations
  void update_jacobian_dot(const Tree& tree, const Matrix6x& tree_jacobian_dot);
  void bias(Out J_dot_v) const;  // requires update_rates

 private:
  void update_relative_rotations(const Tree& tree);
  void update_relative_rotation_rates(const Tree& tree);

  int pair_count_;
  std::vector<Vector3> p_, r_, e_, p_dot_, r_dot_, e_dot_;
  Indices joints_;  // joints that rows are attached to, and their motion
  std::vector<Vector6> velocity_, acceleration_;
  std::vector<std::vector<Wrench>> wrenches_;  // by row
};

}  // namespace ckc
