// Small convex programs with box constraints: a quadratic and a linear one.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Minimize x^T A x / 2 + b^T x with lower <= x <= upper, A positive semidefinite. If A is singular, A x is unique but
// x need not be. False if the solver does not converge.
bool minimize_in_box(const Matrix& A, In b, In lower, In upper, Vector& x);

// Return the largest s for which some x satisfies lower + s <= y + N x <= upper - s. It is negative if y + N x cannot
// be within its bounds, and infinite if there are no bounds.
double maximize_bound_distance(const Matrix& N, In y, In lower, In upper);

}  // namespace ckc
