// Coordinates for q as a vector. Joint coordinates are used as they are. A free root is described by its position and
// its rotation vector from a reference orientation, which is updated along the motion, since no single chart covers
// all rotations.
#pragma once

#include "loops/core.hpp"

namespace ckc {

class Chart {
 public:
  void reset(const Core& core, In q_tree);  // the orientations at q_tree become the references
  bool is_trivial() const { return roots_.empty(); }
  void numbers(const Core& core, In q_tree, Out numbers) const;
  // Compute the tangent step of q that leads from q_tree to `numbers`.
  void tangent_step(const Core& core, In q_tree, In numbers, Out step) const;
  // Compute the rate of the numbers at tangent velocity q_dot.
  void numbers_rate(const Core& core, In q_tree, In q_dot, Out rate) const;
  // Transform d (q_dot, q_ddot) / d (tangent step, q_dot) to d (rate, q_ddot) / d (numbers, q_dot), in place.
  void transform_jacobian(const Core& core, In q_tree, In q_dot, Matrix& jacobian) const;
  // Whether an orientation is so far from its reference that the reference should be updated.
  bool needs_new_reference(In numbers) const;

 private:
  struct Root {
    Tree::Root at;
    int k[6];  // indices of its six numbers in q
    Matrix3 reference;
  };
  std::vector<Root> roots_;
};

}  // namespace ckc
