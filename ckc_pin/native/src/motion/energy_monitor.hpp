// Checks the energy change of each step of a conservative motion.
#pragma once

#include <cmath>

#include "motion/step_end.hpp"

namespace ckc {

class EnergyMonitor {
 public:
  static constexpr double rounding = 1e-13;  // of the energy, relative to |kinetic| + |potential|
  explicit EnergyMonitor(const Core& core) { momentum_.setZero(core.n); }
  // Store the energy at the start of a step, at the core's state.
  void start_step(System& system);
  // Whether a step to the core's state keeps the energy, up to a change that errors within `rtol` and `atol` cause.
  // True if the motion is not conservative.
  bool is_kept(System& system, double rtol, double atol);
  // The same from the energy of `end`. False also if its allowance, the least one, does not decide.
  bool is_kept(const StepEnd& end);
  void accept_step() { start_energy_ = end_energy_; }
  double change = 0.0;  // J, of the last step

 private:
  double energy(System& system);  // sets momentum_ and size_ too; NaN if the motion is not conservative
  double start_energy_ = std::nan(""), end_energy_ = std::nan(""), size_ = 0.0;
  Vector momentum_;
};

}  // namespace ckc
