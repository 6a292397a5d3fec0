// Projection onto the constraint manifold by Newton's method on z, and continuation along q. The algorithm is that of
// `ckc_pin.kinematics.sigma`, which also explains failures.
#pragma once

#include "loops/core.hpp"

namespace ckc {

class ClosureSolver {
 public:
  explicit ClosureSolver(Core& core);

  // Solve phi(q, z) = w for z, starting from q_tree, to `tolerance` or to rounding. Only the part of the residual
  // that z can correct counts. Afterwards the core is at the solution, with J and phi_z factorized. False if it does
  // not converge.
  bool project(In q_tree, In w, double tolerance, bool to_rounding = false);
  // Move from the core's configuration along the straight line to q, staying on the same branch. False if that fails
  // or phi_z is singular at the end. Joints with one degree of freedom only.
  bool continue_to(In q, double tolerance);

  long newton_steps = 0;
  // Newton steps of the last projection. D' is evaluated together with the configuration after as many steps, because
  // that one is likely to be the last. Negative: never.
  int expected_steps = -1;

 private:
  double residual_size();  // reduces residual_ to what z can correct

  Core& core_;
  Vector q_tree_, base_, step_, residual_, z_, q_step_, zero_level_;
};

}  // namespace ckc
