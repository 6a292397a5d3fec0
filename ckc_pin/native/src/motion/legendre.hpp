// Legendre polynomials on [-1, 1], and quadrature nodes.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Values of the first `count` polynomials at x, one row per degree.
Matrix legendre_values(const Vector& x, Eigen::Index count);
// Matrix that maps a series to the series of its derivative, multiplied from the right.
Matrix legendre_derivative_matrix(Eigen::Index degree);
// Zeros of P_s, and of P_s - P_(s - 1), ascending.
Vector gauss_nodes(int s);
Vector radau_nodes(int s);

}  // namespace ckc
