// Springs and dampers between frames or on joints, constant forces.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

struct SpringTable {
  Indices point_joint;  // the ends A of all springs between frames, then the ends B
  std::vector<Vector3> point_local;
  Vector stiffness, rest_length, damping;  // (springs)
  Vector joint_stiffness, joint_rest, joint_damping, constant;  // (n)
};

class Springs {
 public:
  Springs(const Tree& tree, SpringTable table);

  SpringTable table;  // changed by `vary` alone
  bool any, any_damping;
  Eigen::Index count() const { return count_; }

  enum class Number { end, stiffness, rest_length, damping, joint_stiffness, joint_rest, joint_damping, constant };
  void vary(Number what, In numbers);

  void set(const Tree& tree);  // lengths, from the tree's placements and Jacobian
  void add_elastic(const Tree& tree, In q, Out force) const;
  void add_damping(In v, Out force) const;
  double energy(const Tree& tree, In q) const;

 private:
  void look();  // which of them there are

  int count_;
  std::vector<Indices> pattern_;
  Vector length_;
  Matrix jacobian_;  // of the lengths, (springs, n)
};

}  // namespace ckc
