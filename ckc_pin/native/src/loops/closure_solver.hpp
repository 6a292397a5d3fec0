// Newton's method on z, and the way from a closed configuration to another q: what `sigma` of the readable reference does
// along its straight line. Where that ends early nobody says why; the reference does.
#pragma once

#include "loops/core.hpp"

namespace ckc {

class Closing {
 public:
  explicit Closing(Core& core);

  // Close phi(q, z) = w on z from q_tree, the largest part that z can close to `tolerance`, or to rounding; false where
  // that is not got to. J and phi_z's factorization are those of where the core is then.
  bool close(In q_tree, In w, double tolerance, bool to_rounding = false);
  // From where the core is, closed, along the straight line to q; false where that cannot be followed on its branch, or
  // phi_z is singular at its end. Joints of one freedom alone.
  bool move(In q, double tolerance);

  long corrections = 0;
  int expected = -1;  // corrections after which D' will be wanted, and which the last time took; negative: it will not

 private:
  double unclosed();  // of residual_

  Core& core_;
  Vector q_tree_, at_, step_, residual_, z_, dq_, none_;
};

}  // namespace ckc
