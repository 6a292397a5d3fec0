// Allocation of a generalized force to motors with torque limits.
#pragma once

#include <Eigen/Eigenvalues>

#include "tree/linear.hpp"

namespace ckc {

// Allocates u to motor torques. With more motors than freedoms, the torques minimize sum(weight (tau - preload)^2)
// subject to u = transmission^T tau and the torque limits. The dual of this box QP is concave and piecewise quadratic
// in d numbers. Newton's method with an exact line search solves it in finitely many steps.
//
// If no torques within the limits give u, the deviation from u is penalized, so that the torques stay almost
// continuous. Rows of u are scaled by the norms of their rows of transmission^T.
class Allocation {
 public:
  Allocation(int motors, int d, Vector lower, Vector upper, Vector weights, Vector preload);
  void allocate(const Matrix& transmission, In u, Out tau);  // transmission: (motors, d)
  void clamp(Out tau) const { tau = tau.cwiseMin(upper).cwiseMax(lower); }

  bool is_redundant() const { return redundant_; }

  const Vector lower, upper;  // torque limits; infinite where there is none

 private:
  bool solve_with_limits(const Matrix& transmission, In u, Out tau, double penalty_weight);
  bool is_limited(Eigen::Index k) const { return std::isfinite(lower(k)) || std::isfinite(upper(k)); }
  bool is_out_of_reach(In u, double tolerance) const;
  double line_search(double penalty_curvature);  // step length that maximizes the dual; infinite if unbounded

  const Vector weights_, preload_, scale_;
  const bool redundant_;
  Factor factor_;
  Matrix scaled_, curvature_;
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;
  Vector unlimited_;                     // torques without limits
  Vector multiplier_, direction_;        // dual variables, (d); direction of the line search
  double directional_derivative_ = 0.0;  // of the dual along direction_
  Vector residual_, row_scale_, coefficients_;
  Vector unclamped_, tau_direction_;       // torques before clamping, and their derivatives along direction_
  Vector becomes_free_, becomes_limited_;  // step lengths at which a motor leaves a limit and reaches the other
  Vector breakpoints_;                     // both, sorted
  Indices free_;                           // by motor: 1 within its limits, else 0
};

}  // namespace ckc
