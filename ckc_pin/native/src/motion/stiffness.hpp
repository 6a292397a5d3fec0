// Detection of stiffness from the eigenvalues of a Jacobian.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Whether an implicit method is worthwhile for a motion of this duration (s).
//
// A mode lambda has to be resolved until it decays, with steps of about 1 / |lambda|. An explicit method needs such
// steps for the whole duration, an implicit one only until the mode has decayed.
bool is_stiff(const Matrix& jacobian, double duration);

}  // namespace ckc
