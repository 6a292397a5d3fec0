// The way from a closed configuration to another q, for many starts at once: what `sigma` of the readable reference does
// along its straight line. Where that ends early nobody says why; the reference does.
#pragma once

#include "core.hpp"

namespace ckc {

class Closing {
 public:
  Closing(Core& core, Vector reach, double tolerance);

  // From a configuration that is nearly closed to the nearest closed one of the same q; the core is there then.
  bool close(In q_tree);
  // From where the core is, closed, along the straight line to q; false where that cannot be followed on its branch, or
  // phi_z is singular at its end. Joints of one freedom alone.
  bool move(In q);

 private:
  bool newton();  // from q_tree_
  double unclosed();

  Core& core_;
  const Vector reach_;  // (n): what a step is measured in
  const double tolerance_;
  Vector q_tree_, at_, step_, residual_, z_, dq_;
};

}  // namespace ckc
