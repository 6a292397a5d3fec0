// Checks the energy change of each step of a conservative motion.
#pragma once

#include <cmath>

#include "motion/system.hpp"

namespace ckc {

class EnergyMonitor {
 public:
  explicit EnergyMonitor(const Core& core) { momentum_.setZero(core.n); }
  // Store the energy at the start of a step, at the core's state.
  void start_step(System& system);
  // Energy change of a step to the core's state, relative to the change that errors within `rtol` and `atol` cause.
  // Zero if the motion is not conservative.
  double relative_change(System& system, double rtol, double atol);
  void accept_step() { start_energy_ = end_energy_; }
  double change = 0.0;  // J, of the last step

 private:
  double energy(System& system);  // sets momentum_ and size_ too; NaN if the motion is not conservative
  double start_energy_ = std::nan(""), end_energy_ = std::nan(""), size_ = 0.0;
  Vector momentum_;
};

}  // namespace ckc
