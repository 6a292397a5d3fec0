// A convex quadratic program in a box.
#pragma once

#include "types.hpp"

namespace ckc {

// The x that makes x^T A x / 2 + b^T x least between `lower` and `upper`, A positive semidefinite; false where the
// solver does not find it. Where A is singular x need not be unique, A x is.
bool least_in_box(const Matrix& A, In b, In lower, In upper, Vector& x);

}  // namespace ckc
