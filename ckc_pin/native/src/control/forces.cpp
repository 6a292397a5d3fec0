#include "control/forces.hpp"

namespace ckc {

BodyForces::BodyForces(std::vector<BodyForce> forces, int n) : forces_(std::move(forces)) {
  value.setZero(n), wrenches.setZero(6 * static_cast<Eigen::Index>(forces_.size()));
}

void BodyForces::set_segment(double begin, double end, double tolerance) {
  for (const BodyForce& force : forces_) force.wrench->set_segment(begin, end, tolerance);
}

void BodyForces::reset() {
  for (const BodyForce& force : forces_) force.wrench->reset();
}

Vector6 BodyForces::in_world_axes(const Tree& tree, size_t k, Vector3& origin) const {
  const BodyForce& force = forces_[k];
  const Matrix3 rotation = tree.rotation(force.joint);
  origin = rotation * force.origin + tree.translation(force.joint);
  const auto at = 6 * static_cast<Eigen::Index>(k);
  const Vector3 f = wrenches.segment<3>(at), m = wrenches.segment<3>(at + 3);
  Vector6 wrench;
  wrench << f, m;
  if (!force.in_world) wrench << rotation * (force.axes * f), rotation * (force.axes * m);
  wrench.tail<3>() += origin.cross(Vector3(wrench.head<3>()));
  return wrench;
}

bool BodyForces::compute(const MeasuredState& at, ControlFailure& failure) {
  for (size_t k = 0; k < forces_.size(); ++k)
    if (!forces_[k].wrench->evaluate(at, wrenches.segment<6>(6 * static_cast<Eigen::Index>(k)), failure)) return false;
  const Tree& tree = at.core.placed_tree();
  const Matrix6x& columns = tree.jacobian();
  value.setZero();
  Vector3 origin;
  for (size_t k = 0; k < forces_.size(); ++k) {
    if (wrenches.segment<6>(6 * static_cast<Eigen::Index>(k)).isZero(0)) continue;
    const Vector6 wrench = in_world_axes(tree, k, origin);
    for (int j : tree.support[forces_[k].joint]) value(j) += wrench.dot(columns.col(j));
  }
  return value.allFinite();
}

// The force along coordinate j is c_j . w with the joint's twist c_j and the wrench w. A motion along i moves the point
// and, of a wrench in the frame's axes, turns it; and it moves the twists of the joints that it carries: c_i x c_j.
bool BodyForces::add_derivative(Core& core, Matrix& by_q) const {
  const Tree& tree = core.placed_tree();
  const Matrix6x& columns = tree.jacobian();
  Vector3 origin;
  for (size_t k = 0; k < forces_.size(); ++k) {
    if (forces_[k].wrench->depends_on_state()) return false;
    const Vector6 wrench = in_world_axes(tree, k, origin);
    const Vector3 f = wrench.head<3>(), m = wrench.tail<3>() - origin.cross(f);
    const Indices& support = tree.support[forces_[k].joint];
    for (int i : support) {
      const Vector3 linear = columns.col(i).head<3>(), angular = columns.col(i).tail<3>();
      Vector6 change;
      change << Vector3::Zero(), (linear + angular.cross(origin)).cross(f);
      if (!forces_[k].in_world) {
        const Vector3 f_change = angular.cross(f);
        change.head<3>() += f_change;
        change.tail<3>() += angular.cross(m) + origin.cross(f_change);
      }
      for (int j : support) {
        double derivative = change.dot(columns.col(j));
        if (tree.joint_of[i] <= tree.joint_of[j]) {
          const Vector3 linear_j = columns.col(j).head<3>(), angular_j = columns.col(j).tail<3>();
          derivative += wrench.head<3>().dot(angular.cross(linear_j) + linear.cross(angular_j)) +
                        wrench.tail<3>().dot(angular.cross(angular_j));
        }
        by_q(j, i) += derivative;
      }
    }
  }
  return true;
}

}  // namespace ckc
