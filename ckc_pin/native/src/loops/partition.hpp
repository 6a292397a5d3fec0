// Choice of the partition q' = [q; z] by a pivoted factorization.
#pragma once

#include "loops/core.hpp"

namespace ckc {

struct Partition {
  Indices q, z;
};

// Find the partition whose phi_z is best conditioned at the core's configuration. False if it would split a free
// root.
bool find_best_partition(Core& core, Partition& best);

}  // namespace ckc
