#include "tree/joint_motion_derivatives.hpp"

#include "tree/rotation.hpp"

namespace ckc {

namespace {

// Of two spatial motions.
Vector6 cross(const Vector6& a, const Vector6& b) {
  const Vector3 a_turn = a.tail<3>(), b_turn = b.tail<3>(), a_move = a.head<3>(), b_move = b.head<3>();
  Vector6 c;
  c << a_turn.cross(b_move) + a_move.cross(b_turn), a_turn.cross(b_turn);
  return c;
}

}  // namespace

// The axes S of all coordinates at or below one turn with it, S x S', and nothing above moves.
void changes_of(const Tree& tree, int joint, Sway& found) {
  const Indices& support = tree.support[joint];
  const auto count = static_cast<Eigen::Index>(support.size());
  for (Matrix6x* x : {&found.place, &found.velocity, &found.rate, &found.rate_by_v}) x->resize(6, count);
  const Vector6 v = tree.motion(joint), a = tree.motion_rate(joint);
  for (Eigen::Index k = 0; k < count; ++k) {
    const int of = tree.joint_of[support[k]], above = tree.parent[of];
    const Vector6 axis = tree.jacobian().col(support[k]), v_above = tree.motion(above), relative = v - v_above;
    found.place.col(k) = axis;
    found.velocity.col(k) = cross(axis, relative);
    found.rate.col(k) = cross(axis, a - tree.motion_rate(above)) + cross(cross(v_above, axis), relative);
    found.rate_by_v.col(k) = cross(tree.motion(of), axis) + cross(axis, relative);
  }
}

void Carried::set(const Tree& tree, int of, const Vector3& local, bool is_point, const Sway& changes) {
  joint = of;
  const double moves = is_point ? 1.0 : 0.0;
  const Vector6 v = tree.motion(joint), a = tree.motion_rate(joint);
  const Vector3 turn = v.tail<3>(), turn_dot = a.tail<3>();
  x = tree.rotation(joint) * local + moves * tree.translation(joint);
  x_dot = moves * v.head<3>() + turn.cross(x);
  x_ddot = moves * a.head<3>() + turn_dot.cross(x) + turn.cross(x_dot);
  const auto count = changes.place.cols();
  for (Columns* columns : {&by_q, &dot_by_q, &ddot_by_q, &ddot_by_v}) columns->resize(3, count);
  for (Eigen::Index k = 0; k < count; ++k) {
    const auto part = [&](const Matrix6x& of, int at) { return Vector3(of.col(k).segment<3>(at)); };
    const Vector3 by = moves * part(changes.place, 0) + part(changes.place, 3).cross(x);
    const Vector3 dot_by = moves * part(changes.velocity, 0) + part(changes.velocity, 3).cross(x) + turn.cross(by);
    by_q.col(k) = by, dot_by_q.col(k) = dot_by;
    ddot_by_q.col(k) = moves * part(changes.rate, 0) + part(changes.rate, 3).cross(x) + turn_dot.cross(by) +
                       part(changes.velocity, 3).cross(x_dot) + turn.cross(dot_by);
    ddot_by_v.col(k) = moves * part(changes.rate_by_v, 0) + part(changes.rate_by_v, 3).cross(x) +
                       part(changes.place, 3).cross(x_dot) + turn.cross(by);
  }
}

}  // namespace ckc
