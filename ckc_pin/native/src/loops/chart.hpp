// Numbers for q: joint coordinates as they are; a free root's place by its position and the rotation vector from a
// reference orientation, which follows the motion, since no chart of rotations is good everywhere.
#pragma once

#include "loops/core.hpp"

namespace ckc {

class Chart {
 public:
  void start(const Core& core, In q_tree);  // of the core's present q; its orientations are the references
  bool plain() const { return roots_.empty(); }
  void numbers(const Core& core, In q_tree, Out numbers) const;
  // Tangent step of q from a configuration to numbers.
  void step(const Core& core, In q_tree, In numbers, Out step) const;
  // Rate of the numbers at tangent velocity q_dot.
  void rate(const Core& core, In q_tree, In q_dot, Out rate) const;
  // From d (q_dot, q_ddot) / d (tangent step, q_dot) to d (rate, q_ddot) / d (numbers, q_dot), in place.
  void jacobian(const Core& core, In q_tree, In q_dot, Matrix& jacobian) const;
  // Whether an orientation has turned so far from its reference that the chart should follow.
  bool outgrown(In numbers) const;

 private:
  struct Root {
    Tree::Root at;
    int k[6];  // where its six numbers stand among q
    Matrix3 reference;
  };
  std::vector<Root> roots_;
};

}  // namespace ckc
