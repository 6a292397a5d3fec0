// What a step may change in the energy of a motion that conserves it.
#pragma once

#include <cmath>

#include "motion/system.hpp"

namespace ckc {

class EnergyMonitor {
 public:
  explicit EnergyMonitor(const Core& core) { momentum_.setZero(core.n); }
  // Take the energy where a step begins, at the core's state.
  void from(System& system);
  // By how many times its allowance a step to the core's state has changed it; zero where nothing conserves it.
  // `rtol`, `atol`: of the step.
  double at(System& system, double rtol, double atol);
  void kept() { from_ = to_; }  // that step
  double change = 0.0;  // J

 private:
  double energy(System& system);  // and momentum_
  double from_ = std::nan(""), to_ = std::nan(""), size_ = 0.0;
  Vector momentum_;
};

}  // namespace ckc
