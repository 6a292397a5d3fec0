// The closure as the table of row primitives that Python uses, and springs' lengths.
//
// The derivative of every primitive is a sum over one to three joints of a wrench on the joint times the joint's
// Jacobian, with wrench and Jacobian in world axes at the world's origin: J = sum of w . J_joint. So J, J_dot and
// J_dot v are each written once.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

struct Component { int out, pair, direction; };
struct Dot { int out, a, b; };
struct Distance { int out, pair; double length; };
struct Affine { int out; Vector coefficients; double offset; };
struct RelativeLog { int out[3]; int joint_a, joint_b; Matrix3 rotation_a, rotation_b; };

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

class Rows {
 public:
  Rows(const Tree& tree, Closure closure);

  Closure closure;
  std::vector<Indices> pattern;  // by row: the columns of J that are not zero
  Vector phi;                    // (rows)
  Matrix J, J_dot;               // (rows, n); zero outside the pattern

  // Other numbers: points one after the other; of lengths, coefficients and offsets those of all rows.
  enum class Number { point, length, affine, affine_offset };
  void vary(Number what, In numbers);
  std::vector<Indices> pattern_of(const Indices& columns, int n) const;  // of those of n columns, counted among them
  void set(const Tree& tree, In q);  // phi and the wrenches, from the tree's placements
  void jacobian(const Tree& tree);
  void rates(const Tree& tree);      // the wrenches' rates, from the tree's velocities and accelerations
  void jacobian_dot(const Tree& tree, const Matrix6x& tree_jacobian_dot);
  void bias(Out J_dot_v) const;      // after `rates`

 private:
  void relative(const Tree& tree);
  void relative_rates(const Tree& tree);

  int pairs_;
  std::vector<Vector3> p_, r_, e_, p_dot_, r_dot_, e_dot_;
  Indices joints_;  // joints that rows hold on to, and their motion
  std::vector<Vector6> velocity_, acceleration_;
  std::vector<std::vector<Wrench>> wrenches_;  // by row
};

}  // namespace ckc
