// Which coordinates serve as q: those whose z the loops determine best, by a pivoted factorization.
#pragma once

#include "loops/core.hpp"

namespace ckc {

struct Partition {
  Indices q, z;
};

// The split whose phi_z is furthest from singular where the core is; none where it would split a free root.
bool best_partition(Core& core, Partition& found);

}  // namespace ckc
