// Derivatives of the motion of joints, and of points and directions attached to them, with respect to q' and v'.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

// Derivatives of a joint's spatial motion with respect to the coordinates and velocities of its support, one column
// each, in world axes. The derivative of the velocity with respect to v' is `axis`.
struct JointMotionDerivatives {
  Matrix6x axis, velocity_by_q, acceleration_by_q;  // with respect to q'
  Matrix6x acceleration_by_v;                       // with respect to v'
};

// Requires `Tree::compute_derivatives` at the state; overwrites `motion`.
void compute_motion_derivatives(const Tree& tree, int joint, JointMotionDerivatives& motion);

struct AttachedVector {
  using Columns = Eigen::Matrix<double, 3, Eigen::Dynamic>;

  // Evaluate a point (`is_point`) or a direction, given in the joint's own axes.
  void set(const Tree& tree, int of, const Vector3& local, bool is_point, const JointMotionDerivatives& motion);

  int joint = 0;
  Vector3 x, x_dot, x_ddot;
  Columns by_q;  // (3, support); also the derivative of x_dot with respect to v'
  Columns dot_by_q, ddot_by_q, ddot_by_v;
};

}  // namespace ckc
