// The constraint rows of the loop closures, and their Jacobian. They are built from the same primitives as in Python
// (`ckc_pin.mechanism.rows`): the step loop needs them without the interpreter.
//
// The derivative of every primitive is a sum over one to three joints of a wrench times the joint's Jacobian, J = sum
// of w . J_joint, both in world axes at the world's origin. J, J_dot and J_dot v then need one implementation each.
#pragma once

#include "tree/rotation.hpp"
#include "tree/tree.hpp"

namespace ckc {

// The kinds of rows; `out`: index of the row in phi. Pairs of points (A, B) and directions e are those of `Closure`.
struct Component {  // e . (A - B)
  int out, pair, direction;
};
struct Dot {  // e_a . e_b
  int out, a, b;
};
struct Distance {  // (|A - B|^2 - length^2) / (2 length)
  int out, pair;
  double length;
};
struct Affine {  // coefficients . q' - offset
  int out;
  Vector coefficients;  // (n)
  double offset;
};
// A piecewise polynomial p of one coordinate, which an affine row has in addition: coefficients . q' - offset - p.
struct Curve {
  int out, coordinate;
  Vector breaks;        // (pieces - 1), ascending; padded with infinity
  Vector origins;       // (pieces)
  Matrix coefficients;  // (degree + 1, pieces): of the powers of x - origin
  Vector4 evaluate(double x) const;  // p and its first three derivatives
};
struct RelativeLog {  // log(R_A^T R_B), three rows; R: rotation of the joint times a constant rotation
  int out[3];
  int joint_a, joint_b;
  Matrix3 rotation_a, rotation_b;
};

struct Closure {
  int rows;
  Indices point_joint;  // joints of the points A of all pairs, then of the points B
  std::vector<Vector3> point_local;
  Indices direction_joint;
  std::vector<Vector3> direction_local;
  std::vector<Component> components;
  std::vector<Dot> dots;
  std::vector<Distance> distances;
  std::vector<Affine> affine;
  std::vector<Curve> curves;
  std::vector<RelativeLog> logs;
};

// A wrench on a joint, (force, moment) in world axes at the world's origin, and its rate.
struct Wrench {
  int joint;
  Indices coordinates;  // that move the joint, without those that move everything the row is attached to
  Indices places;       // of the coordinates in the row's pattern
  Vector6 w, w_dot;
};

class ConstraintRows {
 public:
  ConstraintRows(const Tree& tree, Closure closure);

  Closure closure;
  // By row: columns of J that are not zero. Coordinates that move everything the row is attached to do not change it.
  std::vector<Indices> pattern;
  Vector phi;    // (rows)
  Matrix J_dot;  // (rows, n); outside the pattern zero, except for rounding errors of compiled terms

  // Replace one kind of parameter: points concatenated; lengths, coefficients and offsets of all rows.
  enum class Parameter { point, length, affine, affine_offset };
  void set_parameters(Parameter parameter, In values);
  // The part of J in some columns. By row: its pattern, as indices into the columns, and the places of these entries
  // in `J_entries`.
  struct Columns {
    std::vector<Indices> pattern, places;
  };
  Columns in_columns(const Indices& columns) const;
  void update(const Tree& tree, In q);  // phi and the wrenches; requires the tree's placements
  void update_jacobian(const Tree& tree);  // requires update
  // J as its entries, row by row in the order of `pattern`, and as a matrix like J_dot. In a large matrix the entries
  // are far apart in memory, so each is computed from the other only when it is needed.
  const std::vector<double>& J_entries();
  const Matrix& J();
  Matrix& J_to_set();  // the matrix, for a caller that computes all of it
  void J_column(int j, Out column);
  // Rates of the wrenches; `motion` provides the joints' velocities and bias accelerations at v.
  template <class Motion>
  void update_rates(const Tree& tree, const Motion& motion, In v) {
    for (int joint : joints_)
      velocity_[joint] = motion.velocity(joint), acceleration_[joint] = motion.bias_acceleration(joint);
    update_rates(tree, v);
  }
  void update_jacobian_dot(const Tree& tree, const Matrix6x& tree_jacobian_dot);
  void bias(Out J_dot_v) const;  // requires update_rates
  void multiply_J(In v, Out product);
  double J_norm();

 private:
  double& entry(int i, int j);
  void update_rates(const Tree& tree, In v);
  void update_relative_rotations(const Tree& tree);
  void update_relative_rotation_rates(const Tree& tree);

  Matrix J_;
  std::vector<double> J_entries_;
  bool J_is_set_ = true, J_entries_are_set_ = false;
  std::vector<std::vector<std::pair<int, int>>> places_in_column_;  // by column: rows, and places in J_entries_
  int pair_count_;
  std::vector<Vector4> curve_values_;             // by curve: p and its derivatives
  Vector curve_rates_;                            // by curve: rate of its coordinate
  std::vector<Vector3> p_, r_, e_;                // points, vectors A - B of the pairs, directions; in world axes
  std::vector<Vector3> p_dot_, r_dot_, e_dot_;    // their rates
  Indices joints_;                                // joints that rows are attached to
  std::vector<Vector6> velocity_, acceleration_;  // by joint, valid for joints_
  std::vector<std::vector<Wrench>> wrenches_;     // by row
  std::vector<LogJacobian> log_jacobians_;        // by relative rotation
};

}  // namespace ckc
