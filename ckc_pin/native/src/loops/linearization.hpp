// Exact linearization of eq. 1 about one state, in minimal coordinates.
#pragma once

#include <memory>

#include <Eigen/QR>

#include "loops/core.hpp"

namespace ckc {

// Linearizes eq. 1 at one state after another. The states are d coordinates and their rates.
class Linearization {
 public:
  // `transmission`: motor rates per coordinate rate, (motors, n).
  Linearization(std::unique_ptr<Core> core, Matrix transmission);

  // Linearize at (q', v') under u' and smooth friction. `u_by_q`: derivative of u' with respect to q' (tangent), empty
  // if it is constant. `locked` coordinates do not move. `correction`: minus the prescribed acceleration of rows. False
  // if J has lost rank.
  bool compute(In q_tree, In v_tree, In u_tree, const Indices& locked, const Matrix& u_by_q, In correction);
  // After `compute`: the acceleration, minimum-norm multipliers, and the multipliers' derivatives.
  void solve_multipliers();

  const std::unique_ptr<Core> core;
  const Matrix transmission;
  Indices coordinates;  // (d): coordinates of the states
  Matrix T, V;          // (n, d): derivatives of v' with respect to the rates and to the positions of the states
  Matrix A, B;          // (2 d, 2 d), (2 d, motors)
  AccelerationDerivatives acceleration;
  Vector lambda;                        // (rows)
  Matrix lambda_q, lambda_v, lambda_u;  // (rows, n)

 private:
  using Pivoted = Eigen::ColPivHouseholderQR<Matrix>;
  bool find_basis();
  Pivoted factorize_with_locked_rows() const;  // J with rows for the locked coordinates, dimensionless
  void set_basis_from(const Pivoted& qr);
  void choose_coordinates(const Indices& free);
  void compute_velocity_dependence(In v);
  void assemble_A_B(In v);

  Matrix rate_by_q_, u_by_q_;
  AppliedForce force_;
  Vector u_tree_, residual_, correction_;
  bool uses_rho_ = false;  // whether T is rho
};

}  // namespace ckc
