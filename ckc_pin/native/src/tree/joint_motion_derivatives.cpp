#include "tree/joint_motion_derivatives.hpp"

#include "tree/rotation.hpp"

namespace ckc {

namespace {

// Cross product of two spatial motions, (linear, angular).
Vector6 cross(const Vector6& a, const Vector6& b) {
  const Vector3 a_turn = a.tail<3>(), b_turn = b.tail<3>(), a_move = a.head<3>(), b_move = b.head<3>();
  Vector6 c;
  c << a_turn.cross(b_move) + a_move.cross(b_turn), a_turn.cross(b_turn);
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
    const int of = tree.joint_of[support[k]], above = tree.parent[of];
    const Vector6 axis = tree.jacobian().col(support[k]), v_above = tree.velocity(above), relative = v - v_above;
    motion.axis.col(k) = axis;
    motion.velocity_by_q.col(k) = cross(axis, relative);
    motion.acceleration_by_q.col(k) = cross(axis, a - tree.acceleration(above)) + cross(cross(v_above, axis), relative);
    motion.acceleration_by_v.col(k) = cross(tree.velocity(of), axis) + cross(axis, relative);
  }
}

void AttachedVector::set(const Tree& tree, int of, const Vector3& local, bool is_point,
                         const JointMotionDerivatives& motion) {
  joint = of;
  const double translates = is_point ? 1.0 : 0.0;
  const Vector6 v = tree.velocity(joint), a = tree.acceleration(joint);
  const Vector3 omega = v.tail<3>(), omega_dot = a.tail<3>();
  x = tree.rotation(joint) * local + translates * tree.translation(joint);
  x_dot = translates * v.head<3>() + omega.cross(x);
  x_ddot = translates * a.head<3>() + omega_dot.cross(x) + omega.cross(x_dot);
  const auto count = motion.axis.cols();
  for (Columns* columns : {&by_q, &dot_by_q, &ddot_by_q, &ddot_by_v}) columns->resize(3, count);
  for (Eigen::Index k = 0; k < count; ++k) {
    const auto part = [&](const Matrix6x& of, int at) { return Vector3(of.col(k).segment<3>(at)); };
    const Vector3 by = translates * part(motion.axis, 0) + part(motion.axis, 3).cross(x);
    const Vector3 dot_by =
        translates * part(motion.velocity_by_q, 0) + part(motion.velocity_by_q, 3).cross(x) + omega.cross(by);
    by_q.col(k) = by, dot_by_q.col(k) = dot_by;
    ddot_by_q.col(k) = translates * part(motion.acceleration_by_q, 0) + part(motion.acceleration_by_q, 3).cross(x) +
                       omega_dot.cross(by) + part(motion.velocity_by_q, 3).cross(x_dot) + omega.cross(dot_by);
    ddot_by_v.col(k) = translates * part(motion.acceleration_by_v, 0) + part(motion.acceleration_by_v, 3).cross(x) +
                       part(motion.axis, 3).cross(x_dot) + omega.cross(by);
  }
}

}  // namespace ckc
