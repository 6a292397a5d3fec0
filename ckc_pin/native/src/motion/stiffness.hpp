// Whether a motion is stiff, by the eigenvalues of its right-hand side.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Whether an implicit method pays over a duration (s).
//
// A mode lambda has to be resolved while it lives, in steps of about 1 / |lambda|. It binds an explicit method to such
// steps for the whole of the duration, an implicit one only until the mode is over.
bool stiff(const Matrix& jacobian, double duration);

}  // namespace ckc
