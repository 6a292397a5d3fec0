// How eq. 1's terms change along the tangent coordinates and with the velocities, exactly.
//
// Of the tree by Pinocchio, of rows and springs by their own second and third derivatives: each is made of scalar products
// of points and directions, phi = a . b, so that phi_ddot = a_ddot . b + 2 a_dot . b_dot + a . b_ddot changes as those do.
#pragma once

#include "tree/joint_motion_derivatives.hpp"
#include "loops/rows.hpp"
#include "tree/springs.hpp"

namespace ckc {

class Derivatives {
 public:
  Derivatives(Tree& tree, const Closure& closure, const SpringTable& springs);

  // At (q', v') with an acceleration and with J^T lambda acting. `impulsive`: of D'a - J^T lambda alone.
  void compute(In q, In v, In a, In lambda, bool impulsive = false);

  Matrix force_by_q, force_by_v;  // (n, n): of D'a + C'v + h' less springs, dampers and J^T lambda
  Matrix row_by_q, row_by_v;      // (rows, n): of J a + J_dot v
  Matrix rate_by_q, J;            // (rows, n): of J v; of phi
  const Carried& end_a(int spring) const { return ends_[spring]; }  // of springs, unless `impulsive`
  const Carried& end_b(int spring) const { return ends_[ends_.size() / 2 + spring]; }

 private:
  // What a row made of x with these weights of x, x_dot, x_ddot adds; its force.
  void add(int row, const Carried& x, const Vector3& w, const Vector3& w_dot, const Vector3& w_ddot);
  void bend(const Carried& x, const Vector3& force);                    // force . x along two coordinates
  void product(const Carried& x, const Carried& y, double weight);      // of their changes along two coordinates
  void add_component(const Component& row, double lambda);
  void add_dot(const Dot& row, double lambda);
  void add_distance(const Distance& row, double lambda);
  void add_log(const RelativeLog& rows, In lambda);
  void add_springs();

  Tree& tree_;
  const Closure& closure_;
  const SpringTable& springs_;
  const int pairs_;
  std::vector<Sway> sways_;                         // by joint, of those that rows and springs hold on to:
  Indices joints_, used_points_, used_directions_;  // and the points and directions that rows are made of
  std::vector<Carried> points_, directions_, ends_;
  Vector by_, dot_by_;
};

}  // namespace ckc
