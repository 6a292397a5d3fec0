// Exact derivatives of the terms of eq. 1 with respect to q' (tangent coordinates) and v'.
//
// Pinocchio differentiates the terms of the tree. Constraint rows and springs consist of scalar products phi = a . b of
// points and directions. Their derivatives follow from phi_ddot = a_ddot . b + 2 a_dot . b_dot + a . b_ddot.
#pragma once

#include "tree/joint_motion_derivatives.hpp"
#include "loops/rows.hpp"
#include "tree/springs.hpp"

namespace ckc {

class DynamicsDerivatives {
 public:
  DynamicsDerivatives(Tree& tree, const Closure& closure, const SpringTable& springs);

  // Differentiate at (q', v') with acceleration a and multipliers lambda. `impulsive`: D'a - J^T lambda only.
  void compute(In q, In v, In a, In lambda, bool impulsive = false);

  Matrix force_by_q, force_by_v;  // (n, n): of D'a + C'v + h' minus springs, dampers and J^T lambda
  Matrix row_by_q, row_by_v;      // (rows, n): of J a + J_dot v
  Matrix rate_by_q, J;            // (rows, n): of J v, and of phi
  // Ends of a spring at the last state; not computed if `impulsive`.
  const AttachedVector& spring_end_a(int spring) const { return spring_ends_[spring]; }
  const AttachedVector& spring_end_b(int spring) const { return spring_ends_[spring_ends_.size() / 2 + spring]; }

 private:
  // Add the contribution of x to a row phi = w . x, where w depends on time.
  void add_row(int row, const AttachedVector& x, const Vector3& w, const Vector3& w_dot, const Vector3& w_ddot);
  // Subtract the second derivatives of force . x, and the mixed derivatives of weight x . y, from force_by_q.
  void add_curvature(const AttachedVector& x, const Vector3& force);
  void add_product(const AttachedVector& x, const AttachedVector& y, double weight);
  void add_component(const Component& row, double lambda);
  void add_dot(const Dot& row, double lambda);
  void add_distance(const Distance& row, double lambda);
  void add_curve(const Curve& row, In q, In v, In a, double lambda);
  void add_log(const RelativeLog& rows, In lambda);
  void add_springs();

  Tree& tree_;
  const Closure& closure_;
  const SpringTable& springs_;
  const int pairs_;
  Indices joints_;                                    // joints that rows and springs are attached to
  std::vector<JointMotionDerivatives> joint_motion_;  // by joint, valid for joints_
  Indices used_points_, used_directions_;             // points and directions of the closure that rows use
  std::vector<AttachedVector> points_, directions_, spring_ends_;
  Vector by_, dot_by_;
};

}  // namespace ckc
