// Springs and dampers between frames or on joints, and constant joint forces.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

struct SpringTable {
  Indices point_joint;  // the ends A of all springs between frames, then the ends B
  std::vector<Vector3> point_local;
  Vector stiffness, rest_length, damping;                       // (springs)
  Vector joint_stiffness, joint_rest, joint_damping, constant;  // (n)
};

class Springs {
 public:
  Springs(const Tree& tree, SpringTable table);

  SpringTable table;  // modified by `set_parameters` only
  bool has_elastic_forces, has_damping;
  Eigen::Index count() const { return count_; }

  enum class Parameter { end, stiffness, rest_length, damping, joint_stiffness, joint_rest, joint_damping, constant };
  // Replace one kind of parameter for all springs, coordinates, or ends (A of all springs, then B).
  void set_parameters(Parameter parameter, In values);

  void update_lengths(const Tree& tree);  // requires the tree's placements and Jacobian
  void add_elastic_force(const Tree& tree, In q, Out force) const;
  void add_damping_force(In v, Out force) const;
  double energy(const Tree& tree, In q) const;

 private:
  void update_flags();  // sets has_elastic_forces and has_damping

  int count_;
  std::vector<Indices> pattern_;
  Vector length_;
  Matrix jacobian_;  // Jacobian of the lengths, (springs, n)
};

}  // namespace ckc
