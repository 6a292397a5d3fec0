// How motors share a force on the freedoms.
#pragma once

#include <Eigen/Eigenvalues>

#include "tree/linear.hpp"

namespace ckc {

// Of all tau with u = transmission^T tau, that nearest to a preload in the metric of weights, within limits: a small box QP.
// Its dual is concave and piecewise quadratic in d numbers, and Newton's method with an exact line search ends on it after
// finitely many steps. Where the limits leave no such tau, what u is missed by has a price, each row of u measured by what
// one unit of all motors does in it: what they do together hardly jumps there.
class Allocation {
 public:
  Allocation(int motors, int d, Vector limit, Vector weights, Vector preload);
  void share(const Matrix& transmission, In u, Out tau);  // transmission: (motors, d)
  void clip(Out tau) const { tau = tau.cwiseMin(limit).cwiseMax(-limit); }

  bool redundant() const { return redundant_; }

  const Vector limit;  // infinite where there is none

 private:
  bool within_limits(const Matrix& transmission, In u, Out tau, double give);
  bool beyond(In u, double least) const;
  double along(double bent);  // how far along direction_ the dual is largest; infinite where it grows without end

  const Vector weights_, preload_, scale_;
  const bool redundant_;
  Factor factor_;
  Matrix scaled_, curvature_;
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;
  Vector unlimited_, rest_, row_scale_, multiplier_, direction_, coefficients_, raw_, slope_, enters_, leaves_, ends_;
  Indices free_;       // whether a motor is within its limits
  double rise_ = 0.0;  // of the dual along direction_
};

}  // namespace ckc
