// What a run keeps at its output instants: `simulation.record`.
#pragma once

#include "system.hpp"

namespace ckc {

class Record {
 public:
  explicit Record(const Core& core);

  // t, q', velocity, tau, phi, w, energy, Lyapunov function, largest |phi - w|, largest |phi_dot - w_dot|
  int width;
  // A row at (t, y); false where the state has no terms.
  bool row(System& system, double t, In y, Out row);

 private:
  Vector product_;
};

}  // namespace ckc
