// Cosines and sines of many angles at once.
#pragma once

#include "tree/types.hpp"

namespace ckc {

class Trig {
 public:
  // The cosines of x, then the sines; computed again when x is another one.
  const double* of(In x) const {
    if (x.size() == x_.size() && x == x_) return values_.data();
    return compute(x);
  }

 private:
  const double* compute(In x) const;
  mutable Vector x_, values_, padded_;
};

}  // namespace ckc
