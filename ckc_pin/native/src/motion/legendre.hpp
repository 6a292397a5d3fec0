// Legendre polynomials, and the quadrature nodes that are zeros of them, on [-1, 1].
#pragma once

#include "tree/types.hpp"

namespace ckc {

// The first polynomials at places, a row a degree.
Matrix legendre(const Vector& x, Eigen::Index count);
// Coefficients of the derivatives: from a series, acting from the right.
Matrix legendre_derivation(Eigen::Index degree);
// Zeros of P_s, and of P_s - P_(s - 1), ascending.
Vector gauss_nodes(int s);
Vector radau_nodes(int s);

}  // namespace ckc
