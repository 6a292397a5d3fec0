// Cosines and sines of several angles at once, cached for the last angles.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Compute cosines and sines of numbers, as many as a multiple of four. They may lie one behind the other in memory.
void compute_cosines_and_sines(const double* x, Eigen::Index count, double* cosines, double* sines);
// The same for numbers that were stored as vectors of eight, as many as a multiple of eight. The digits are the same.
void compute_cosines_and_sines_of_vectors(const double* x, Eigen::Index count, double* cosines, double* sines);

class Trig {
 public:
  // Return the cosines of x, followed by the sines. They are computed again only if x has changed.
  const double* cosines_and_sines(In x) const {
    if (x.size() == x_.size() && x == x_) return values_.data();
    return compute(x);
  }

 private:
  const double* compute(In x) const;
  mutable Vector x_, values_, padded_;
};

}  // namespace ckc
