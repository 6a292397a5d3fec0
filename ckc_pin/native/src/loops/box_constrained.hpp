// Small convex programs in a box.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// The x that makes x^T A x / 2 + b^T x least between `lower` and `upper`, A positive semidefinite; false where the
// solver does not find it. Where A is singular x need not be unique, A x is.
bool least_in_box(const Matrix& A, In b, In lower, In upper, Vector& x);

// The largest s for which some x has lower + s <= y + N x <= upper - s: how far y can be kept away from its bounds by
// what N adds to it, negative where it cannot be within them. Infinite where nothing limits it.
double largest_slack(const Matrix& N, In y, In lower, In upper);

}  // namespace ckc
