#include "motion/energy_monitor.hpp"

#include <cmath>

namespace ckc {

constexpr double rounding = 1e-13;  // of kinetic and potential energy

double EnergyMonitor::energy(System& system) {
  Core& core = system.core;
  const bool dissipates = core.springs.any_damping || core.joints.acts();
  if (!system.conserves() || system.control.acts() || dissipates) return std::nan("");
  const Energy energy = core.energy(system.velocity, momentum_);
  size_ = energy.kinetic + std::abs(energy.potential);
  return energy.total();
}

void EnergyMonitor::from(System& system) { from_ = to_ = energy(system); }

// A state within its tolerance is off by (atol + rtol |x|) in each number, and the energy by that times its gradient:
// the momentum, and the forces, of which C'v' counts as one here.
double EnergyMonitor::at(System& system, double rtol, double atol) {
  to_ = energy(system);
  if (std::isnan(from_) || std::isnan(to_)) return 0.0;
  Core& core = system.core;
  core.set_velocity(system.velocity), core.bias();
  double allowed = rounding * size_;
  for (int k = 0; k < core.n; ++k)
    allowed += std::abs(momentum_(k)) * (atol + rtol * std::abs(system.velocity(k))) +
               std::abs(core.bias_tree(k)) * (atol + rtol * std::abs(core.q_tree(core.tree.place[k])));
  change = to_ - from_;
  return std::abs(change) / allowed;
}

}  // namespace ckc
