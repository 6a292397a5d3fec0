// Allocation of a generalized force to motors.
#pragma once

#include <Eigen/Eigenvalues>

#include "tree/linear.hpp"

namespace ckc {

// Allocates u to motor torques. With more motors than freedoms, the torques minimize sum(weight (tau - preload)^2)
// subject to u = transmission^T tau and the torque limits. The dual of this box QP is concave and piecewise quadratic
// in d numbers. Newton's method with an exact line search solves it in finitely many steps.
//
// If no torques within the limits give u, the deviation from u is penalized. Each row of u is measured by what one
// unit of all motors contributes to it, so the torques stay almost continuous there.
class Allocation {
 public:
  Allocation(int motors, int d, Vector limit, Vector weights, Vector preload);
  void allocate(const Matrix& transmission, In u, Out tau);  // transmission: (motors, d)
  void clamp(Out tau) const { tau = tau.cwiseMin(limit).cwiseMax(-limit); }

  bool is_redundant() const { return redundant_; }

  const Vector limit;  // infinite where there is none

 private:
  bool solve_with_limits(const Matrix& transmission, In u, Out tau, double penalty_weight);
  bool is_out_of_reach(In u, double tolerance) const;
  double line_search(double penalty_curvature);  // step length that maximizes the dual; infinite if it is unbounded

  const Vector weights_, preload_, scale_;
  const bool redundant_;
  Factor factor_;
  Matrix scaled_, curvature_;
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;
  Vector unlimited_, residual_, row_scale_, multiplier_, direction_, coefficients_, unclamped_, tau_direction_,
      becomes_free_, becomes_limited_, breakpoints_;
  Indices free_;                         // 1 for a motor within its limits
  double directional_derivative_ = 0.0;  // of the dual along direction_
};

}  // namespace ckc
