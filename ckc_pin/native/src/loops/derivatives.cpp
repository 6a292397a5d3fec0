#include "loops/derivatives.hpp"

#include <algorithm>

#include "tree/rotation.hpp"

namespace ckc {

namespace {

void unique(Indices& of) {
  std::sort(of.begin(), of.end());
  of.erase(std::unique(of.begin(), of.end()), of.end());
}

}  // namespace

DynamicsDerivatives::DynamicsDerivatives(Tree& tree, const Closure& closure, const SpringTable& springs)
    : tree_(tree), closure_(closure), springs_(springs), pairs_(static_cast<int>(closure.point_joint.size()) / 2) {
  for (Matrix* x : {&row_by_q, &row_by_v, &rate_by_q, &J}) x->setZero(closure.rows, tree.n);
  const auto pair = [&](int k) { used_points_.push_back(k), used_points_.push_back(pairs_ + k); };
  for (const auto& row : closure.components) pair(row.pair), used_directions_.push_back(row.direction);
  for (const auto& row : closure.distances) pair(row.pair);
  for (const auto& row : closure.dots) used_directions_.push_back(row.a), used_directions_.push_back(row.b);
  unique(used_points_), unique(used_directions_);
  for (int k : used_points_) joints_.push_back(closure.point_joint[k]);
  for (int k : used_directions_) joints_.push_back(closure.direction_joint[k]);
  for (const auto& rows : closure.logs) joints_.push_back(rows.joint_a), joints_.push_back(rows.joint_b);
  joints_.insert(joints_.end(), springs.point_joint.begin(), springs.point_joint.end());
  unique(joints_);
  joint_motion_.resize(tree.joints), points_.resize(closure.point_joint.size());
  directions_.resize(closure.direction_joint.size()), spring_ends_.resize(springs.point_joint.size());
  by_.setZero(tree.n), dot_by_.setZero(tree.n);
}

void DynamicsDerivatives::compute(In q, In v, In a, In lambda, bool impulsive) {
  tree_.compute_derivatives(q, v, a, !impulsive, force_by_q, force_by_v);
  for (int joint : joints_) compute_motion_derivatives(tree_, joint, joint_motion_[joint]);
  for (int k : used_points_) {
    const int joint = closure_.point_joint[k];
    points_[k].set(tree_, joint, closure_.point_local[k], true, joint_motion_[joint]);
  }
  for (int k : used_directions_) {
    const int joint = closure_.direction_joint[k];
    directions_[k].set(tree_, joint, closure_.direction_local[k], false, joint_motion_[joint]);
  }
  for (Matrix* x : {&row_by_q, &row_by_v, &rate_by_q, &J}) x->setZero();
  for (const auto& row : closure_.components) add_component(row, lambda(row.out));
  for (const auto& row : closure_.dots) add_dot(row, lambda(row.out));
  for (const auto& row : closure_.distances) add_distance(row, lambda(row.out));
  for (const auto& rows : closure_.logs) add_log(rows, lambda);
  for (const auto& row : closure_.affine) J.row(row.out) = row.coefficients;
  for (const auto& row : closure_.curves) add_curve(row, q, v, a, lambda(row.out));
  if (!impulsive) add_springs();
}

void DynamicsDerivatives::add_row(int row, const AttachedVector& x, const Vector3& w, const Vector3& w_dot,
                                  const Vector3& w_ddot) {
  const Indices& support = tree_.support[x.joint];
  for (size_t k = 0; k < support.size(); ++k) {
    const int j = support[k];
    J(row, j) += w.dot(x.by_q.col(k));
    rate_by_q(row, j) += w_dot.dot(x.by_q.col(k)) + w.dot(x.dot_by_q.col(k));
    row_by_q(row, j) += w_ddot.dot(x.by_q.col(k)) + 2 * w_dot.dot(x.dot_by_q.col(k)) + w.dot(x.ddot_by_q.col(k));
    row_by_v(row, j) += 2 * w_dot.dot(x.by_q.col(k)) + w.dot(x.ddot_by_v.col(k));
  }
}

// Second derivative of force . x along two coordinates. A coordinate rotates the axes of its own joint and of the
// joints below it.
void DynamicsDerivatives::add_curvature(const AttachedVector& x, const Vector3& force) {
  const Indices& support = tree_.support[x.joint];
  for (size_t b = 0; b < support.size(); ++b)
    for (size_t a = 0; a < support.size(); ++a) {
      const int column = support[a], row = support[b];
      const bool rotates = a <= b || tree_.joint_of[column] == tree_.joint_of[row];
      const size_t above = rotates ? a : b, below = rotates ? b : a;
      const Vector3 axis = tree_.jacobian().col(support[above]).tail<3>();
      force_by_q(row, column) -= force.dot(axis.cross(Vector3(x.by_q.col(below))));
    }
}

void DynamicsDerivatives::add_product(const AttachedVector& x, const AttachedVector& y, double weight) {
  const Indices &rows = tree_.support[x.joint], &columns = tree_.support[y.joint];
  for (size_t i = 0; i < rows.size(); ++i)
    for (size_t k = 0; k < columns.size(); ++k)
      force_by_q(rows[i], columns[k]) -= weight * x.by_q.col(i).dot(y.by_q.col(k));
}

void DynamicsDerivatives::add_component(const Component& row, double lambda) {
  const AttachedVector &a = points_[row.pair], &b = points_[pairs_ + row.pair], &e = directions_[row.direction];
  const Vector3 r = a.x - b.x, r_dot = a.x_dot - b.x_dot, r_ddot = a.x_ddot - b.x_ddot;
  add_row(row.out, a, e.x, e.x_dot, e.x_ddot), add_row(row.out, b, -e.x, -e.x_dot, -e.x_ddot),
      add_row(row.out, e, r, r_dot, r_ddot);
  add_curvature(a, lambda * e.x), add_curvature(b, -lambda * e.x), add_curvature(e, lambda * r);
  add_product(e, a, lambda), add_product(a, e, lambda), add_product(e, b, -lambda), add_product(b, e, -lambda);
}

void DynamicsDerivatives::add_dot(const Dot& row, double lambda) {
  const AttachedVector &a = directions_[row.a], &b = directions_[row.b];
  add_row(row.out, a, b.x, b.x_dot, b.x_ddot), add_row(row.out, b, a.x, a.x_dot, a.x_ddot);
  add_curvature(a, lambda * b.x), add_curvature(b, lambda * a.x);
  add_product(a, b, lambda), add_product(b, a, lambda);
}

void DynamicsDerivatives::add_distance(const Distance& row, double lambda) {
  const AttachedVector &a = points_[row.pair], &b = points_[pairs_ + row.pair];
  const double scale = 1.0 / row.length, weight = scale * lambda;
  const Vector3 r = scale * (a.x - b.x), r_dot = scale * (a.x_dot - b.x_dot), r_ddot = scale * (a.x_ddot - b.x_ddot);
  add_row(row.out, a, r, r_dot, r_ddot), add_row(row.out, b, -r, -r_dot, -r_ddot);
  add_curvature(a, lambda * r), add_curvature(b, -lambda * r);
  add_product(a, a, weight), add_product(b, b, weight), add_product(a, b, -weight), add_product(b, a, -weight);
}

void DynamicsDerivatives::add_curve(const Curve& row, In q, In v, In a, double lambda) {
  const int k = row.coordinate;
  const Vector4 p = row.evaluate(q(tree_.q_index[k]));
  J(row.out, k) -= p(1);
  rate_by_q(row.out, k) -= p(2) * v(k);
  row_by_q(row.out, k) -= p(2) * a(k) + p(3) * v(k) * v(k);
  row_by_v(row.out, k) -= 2 * p(2) * v(k);
  force_by_q(k, k) += lambda * p(2);
}

// u = log(R_A^T R_B), u_dot = Jlog(u) R_B^T (omega_B - omega_A).
void DynamicsDerivatives::add_log(const RelativeLog& rows, In lambda) {
  const Matrix3 r_a = tree_.rotation(rows.joint_a) * rows.rotation_a,
                r_b = tree_.rotation(rows.joint_b) * rows.rotation_b;
  const LogJacobian log(log3(r_a.transpose() * r_b));
  const Vector3 omega_b = tree_.velocity(rows.joint_b).tail<3>();
  const Vector3 omega = omega_b - tree_.velocity(rows.joint_a).tail<3>();
  const Vector3 alpha = (tree_.acceleration(rows.joint_b) - tree_.acceleration(rows.joint_a)).tail<3>();
  const Vector3 relative_alpha = alpha - omega_b.cross(omega);
  const Vector3 y = r_b.transpose() * omega, y_dot = r_b.transpose() * relative_alpha;
  const Vector3 u_dot = log.value * y;
  const Matrix3 value_dot = log.derivative(u_dot);
  const Vector3 force(lambda(rows.out[0]), lambda(rows.out[1]), lambda(rows.out[2]));
  const int n = tree_.n;
  AttachedVector::Columns angle = AttachedVector::Columns::Zero(3, n), velocity = angle, rate = angle,
                          rate_by_v = angle, of_b = angle, velocity_b = angle;
  const auto add_joint = [&](int joint, double sign) {
    const Indices& support = tree_.support[joint];
    const JointMotionDerivatives& s = joint_motion_[joint];
    for (size_t k = 0; k < support.size(); ++k) {
      const int j = support[k];
      angle.col(j) += sign * s.axis.col(k).tail<3>(), velocity.col(j) += sign * s.velocity_by_q.col(k).tail<3>();
      rate.col(j) += sign * s.acceleration_by_q.col(k).tail<3>(),
          rate_by_v.col(j) += sign * s.acceleration_by_v.col(k).tail<3>();
      if (sign > 0) of_b.col(j) = s.axis.col(k).tail<3>(), velocity_b.col(j) = s.velocity_by_q.col(k).tail<3>();
    }
  };
  add_joint(rows.joint_a, -1.0), add_joint(rows.joint_b, 1.0);
  const auto add_to_rows = [&](Matrix& matrix, int j, const Vector3& x) {
    for (int i = 0; i < 3; ++i) matrix(rows.out[i], j) += x(i);
  };
  for (int j = 0; j < n; ++j) {
    const Vector3 theta = angle.col(j), theta_b = of_b.col(j), omega_j = velocity.col(j);
    const Vector3 u_j = log.value * (r_b.transpose() * theta);
    const Vector3 y_j = r_b.transpose() * (omega_j - theta_b.cross(omega));
    const Vector3 relative_alpha_j = rate.col(j) - velocity_b.col(j).cross(omega) - omega_b.cross(omega_j);
    const Vector3 y_dot_j = r_b.transpose() * (relative_alpha_j - theta_b.cross(relative_alpha));
    const Vector3 u_dot_j = log.derivative(u_j) * y + log.value * y_j;
    add_to_rows(J, j, u_j), add_to_rows(rate_by_q, j, u_dot_j);
    add_to_rows(row_by_q, j,
                log.second_derivative(u_j, u_dot) * y + log.derivative(u_dot_j) * y + value_dot * y_j +
                    log.derivative(u_j) * y_dot + log.value * y_dot_j);
    // The derivative of omega with respect to v'(j) equals that of the orientation with respect to coordinate j.
    const Vector3 y_v = r_b.transpose() * theta, u_dot_v = log.value * y_v;
    const Vector3 relative_alpha_v = rate_by_v.col(j) - theta_b.cross(omega) - omega_b.cross(theta);
    add_to_rows(row_by_v, j,
                log.derivative(u_dot_v) * y + value_dot * y_v + log.value * (r_b.transpose() * relative_alpha_v));
    for (int i = 0; i < n; ++i) {  // the force on coordinate i
      const Vector3 theta_i = angle.col(i);
      if (theta_i.isZero(0)) continue;
      const Indices& above = tree_.ancestors[i];
      const bool rotates = tree_.joint_of[i] == tree_.joint_of[j] || std::binary_search(above.begin(), above.end(), j);
      const Vector3 axis = tree_.jacobian().col(j).tail<3>();
      const Vector3 rotated = (rotates ? axis.cross(theta_i) : Vector3::Zero()) - theta_b.cross(theta_i);
      force_by_q(i, j) -=
          force.dot(log.derivative(u_j) * (r_b.transpose() * theta_i) + log.value * (r_b.transpose() * rotated));
    }
  }
}

void DynamicsDerivatives::add_springs() {
  const SpringTable& s = springs_;
  const auto count = s.stiffness.size();
  force_by_q.diagonal() += s.joint_stiffness, force_by_v.diagonal() += s.joint_damping;
  for (Eigen::Index k = 0; k < count; ++k) {
    for (const Eigen::Index i : {k, count + k}) {
      const int joint = s.point_joint[i];
      spring_ends_[i].set(tree_, joint, s.point_local[i], true, joint_motion_[joint]);
    }
    const AttachedVector &a = spring_ends_[k], &b = spring_ends_[count + k];
    const Vector3 r = a.x - b.x, r_dot = a.x_dot - b.x_dot;
    const double length = r.norm();
    if (!(length > 0.0)) {  // A spring of length zero is differentiable only if its rest length is zero.
      const double pull = s.rest_length(k) == 0.0 ? -s.stiffness(k) : 0.0;
      add_product(a, a, pull), add_product(b, b, pull), add_product(a, b, -pull), add_product(b, a, -pull);
      continue;
    }
    Vector &by = by_, &dot_by = dot_by_;  // derivatives of the length and of its rate
    by.setZero(), dot_by.setZero();
    const double length_dot = r.dot(r_dot) / length;
    const auto add_end = [&](const AttachedVector& x, double sign) {
      const Indices& support = tree_.support[x.joint];
      for (size_t i = 0; i < support.size(); ++i) {
        by(support[i]) += sign * r.dot(x.by_q.col(i)) / length;
        dot_by(support[i]) += sign * (r_dot.dot(x.by_q.col(i)) + r.dot(x.dot_by_q.col(i))) / length;
      }
    };
    add_end(a, 1.0), add_end(b, -1.0);
    dot_by -= length_dot / length * by;
    const double pull = s.stiffness(k) * (length - s.rest_length(k)) + s.damping(k) * length_dot,
                 weight = -pull / length;
    add_curvature(a, weight * r), add_curvature(b, -weight * r);
    add_product(a, a, weight), add_product(b, b, weight), add_product(a, b, -weight), add_product(b, a, -weight);
    dot_by *= s.damping(k), dot_by += (s.stiffness(k) - pull / length) * by;
    force_by_q.noalias() += by * dot_by.transpose();
    force_by_v.noalias() += s.damping(k) * by * by.transpose();
  }
}

}  // namespace ckc
