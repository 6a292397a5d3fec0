// Derivatives of the motion of joints, and of points and directions attached to them, with respect to q' and v'.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

// Derivatives of a joint's spatial motion with respect to the coordinates and velocities of its support, one column
// each, in world axes.
struct JointMotionDerivatives {
  Matrix6x axis;  // of the placement with respect to q', and of the velocity with respect to v'
  Matrix6x velocity_by_q, acceleration_by_q, acceleration_by_v;
};

// Requires `Tree::compute_derivatives` at the state; overwrites `motion`.
void compute_motion_derivatives(const Tree& tree, int joint, JointMotionDerivatives& motion);

// A point or a direction attached to a joint, and its derivatives, in world axes.
struct AttachedVector {
  using Columns = Eigen::Matrix<double, 3, Eigen::Dynamic>;

  // Evaluate the point (`is_point`) or direction `local`, given in the axes of the joint.
  void set(const Tree& tree, int joint, const Vector3& local, bool is_point, const JointMotionDerivatives& motion);

  int joint = 0;
  Vector3 x, x_dot, x_ddot;
  // (3, support): by_q and dot_by_q are derivatives of x and x_dot, ddot_by_q and ddot_by_v of x_ddot. The derivative
  // of x_dot with respect to v' is by_q.
  Columns by_q, dot_by_q, ddot_by_q, ddot_by_v;
};

}  // namespace ckc
