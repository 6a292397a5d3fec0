// A mechanism about one state: eq. 1 in minimal coordinates, differentiated exactly.
#pragma once

#include <memory>

#include <Eigen/QR>

#include "loops/core.hpp"

namespace ckc {

class Plant {
 public:
  // `turns`: of the motors by the coordinates' rates, (motors, n).
  Plant(std::unique_ptr<Core> core, Matrix turns);

  // At (q', v') where u' acts, which does not change with the state, beside smooth friction; `locked` coordinates do not
  // move. False where J has lost rank.
  bool compute(In q_tree, In v_tree, In u_tree, const Indices& locked);
  // After it: a and the least multipliers, and how these change.
  void solve();

  const std::unique_ptr<Core> core;
  const Matrix turns;
  Indices at;                   // (d): the coordinates that the states are of
  Matrix T, V;                  // (n, d): v' by the rates of those, and by those, as the loops ask for it
  Matrix A, B;                  // (2 d, 2 d), (2 d, motors)
  Vector a, lambda;             // (n), (rows)
  Matrix a_q, a_v, a_u;         // (n, n): of a by q' (tangent), v' and u'
  Matrix lambda_q, lambda_v, lambda_u;  // (rows, n)

 private:
  using Pivoted = Eigen::ColPivHouseholderQR<Matrix>;
  bool basis();
  Pivoted with_locked() const;  // J and the locked coordinates' rows, free of units, factorized
  void basis_of(const Pivoted& qr);
  void choose(const Indices& free);
  void follow(In v);
  void assemble(In v);

  Matrix u_by_q_, u_by_v_, opened_;
  Vector force_, given_, residual_;
  bool own_ = false;  // T is rho
};

}  // namespace ckc
