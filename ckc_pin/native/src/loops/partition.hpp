// Choice of the partition q' = [q; z] by a pivoted factorization, or by exchanges of coordinates.
#pragma once

#include "loops/core.hpp"

namespace ckc {

// Coordinates above which J is not pivoted while a partition is well conditioned: the time of pivoting grows as n^3.
constexpr int max_pivoted_size = 300;

struct Partition {
  Indices q, z;
};

// Find the partition whose phi_z is best conditioned at the core's configuration. False if it would split a free
// root.
bool find_best_partition(Core& core, Partition& best);

}  // namespace ckc
