// A chart: q as a vector of d coordinates. Joint coordinates are used as they are. A free root has its position and its
// rotation vector from a reference orientation. The reference is updated along the motion, because no single chart
// covers all rotations.
#pragma once

#include "loops/core.hpp"

namespace ckc {

class Chart {
 public:
  void reset(const Core& core, In q_tree);  // the orientations at q_tree become the references
  bool is_trivial() const { return roots_.empty(); }
  void coordinates(const Core& core, In q_tree, Out coordinates) const;
  // Compute the tangent step of q from q_tree to the point with these coordinates.
  void tangent_step(const Core& core, In q_tree, In coordinates, Out step) const;
  // Compute the rates of the coordinates at the tangent velocity q_dot.
  void coordinate_rates(const Core& core, In q_tree, In q_dot, Out rate) const;
  // Transform d (q_dot, q_ddot) / d (tangent step, q_dot) to d (rates, q_ddot) / d (coordinates, q_dot), in place.
  void transform_jacobian(const Core& core, In q_tree, In q_dot, Matrix& jacobian) const;
  // Whether an orientation is so far from its reference that the reference should be updated.
  bool needs_new_reference(In coordinates) const;

 private:
  struct Root {
    Tree::Root at;
    int k[6];  // indices of its coordinates in q
    Matrix3 reference;
  };
  std::vector<Root> roots_;
};

}  // namespace ckc
