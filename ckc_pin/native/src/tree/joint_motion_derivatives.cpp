#include "tree/joint_motion_derivatives.hpp"

#include "tree/rotation.hpp"

namespace ckc {

namespace {

// Cross product of two spatial motions, (linear, angular).
Vector6 cross(const Vector6& a, const Vector6& b) {
  const Vector3 a_angular = a.tail<3>(), b_angular = b.tail<3>(), a_linear = a.head<3>(), b_linear = b.head<3>();
  Vector6 c;
  c << a_angular.cross(b_linear) + a_linear.cross(b_angular), a_angular.cross(b_angular);
  return c;
}

}  // namespace

// Differentiating along a coordinate rotates the axes S of all coordinates at or below it by S x S'. The motion of
// bodies above the coordinate does not depend on it.
void compute_motion_derivatives(const Tree& tree, int joint, JointMotionDerivatives& motion) {
  const Indices& support = tree.support[joint];
  const auto count = static_cast<Eigen::Index>(support.size());
  for (Matrix6x* x : {&motion.axis, &motion.velocity_by_q, &motion.acceleration_by_q, &motion.acceleration_by_v})
    x->resize(6, count);
  const Vector6 v = tree.velocity(joint), a = tree.acceleration(joint);
  for (Eigen::Index k = 0; k < count; ++k) {
    const int moving_joint = tree.joint_of[support[k]], parent = tree.parent[moving_joint];
    const Vector6 axis = tree.jacobian().col(support[k]), v_parent = tree.velocity(parent), relative = v - v_parent;
    motion.axis.col(k) = axis;
    motion.velocity_by_q.col(k) = cross(axis, relative);
    motion.acceleration_by_q.col(k) =
        cross(axis, a - tree.acceleration(parent)) + cross(cross(v_parent, axis), relative);
    motion.acceleration_by_v.col(k) = cross(tree.velocity(moving_joint), axis) + cross(axis, relative);
  }
}

void AttachedVector::set(const Tree& tree, int joint_, const Vector3& local, bool is_point,
                         const JointMotionDerivatives& motion) {
  joint = joint_;
  const double translates = is_point ? 1.0 : 0.0;
  const Vector6 v = tree.velocity(joint), a = tree.acceleration(joint);
  const Vector3 omega = v.tail<3>(), omega_dot = a.tail<3>();
  x = tree.rotation(joint) * local + translates * tree.translation(joint);
  x_dot = translates * v.head<3>() + omega.cross(x);
  x_ddot = translates * a.head<3>() + omega_dot.cross(x) + omega.cross(x_dot);
  const auto count = motion.axis.cols();
  for (Columns* columns : {&by_q, &dot_by_q, &ddot_by_q, &ddot_by_v}) columns->resize(3, count);
  for (Eigen::Index k = 0; k < count; ++k) {
    const auto linear = [&](const Matrix6x& twists) { return Vector3(twists.col(k).segment<3>(0)); };
    const auto angular = [&](const Matrix6x& twists) { return Vector3(twists.col(k).segment<3>(3)); };
    const Vector3 by = translates * linear(motion.axis) + angular(motion.axis).cross(x);
    const Vector3 dot_by =
        translates * linear(motion.velocity_by_q) + angular(motion.velocity_by_q).cross(x) + omega.cross(by);
    by_q.col(k) = by, dot_by_q.col(k) = dot_by;
    ddot_by_q.col(k) = translates * linear(motion.acceleration_by_q) + angular(motion.acceleration_by_q).cross(x) +
                       omega_dot.cross(by) + angular(motion.velocity_by_q).cross(x_dot) + omega.cross(dot_by);
    ddot_by_v.col(k) = translates * linear(motion.acceleration_by_v) + angular(motion.acceleration_by_v).cross(x) +
                       angular(motion.axis).cross(x_dot) + omega.cross(by);
  }
}

}  // namespace ckc
