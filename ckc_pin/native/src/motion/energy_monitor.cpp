#include "motion/energy_monitor.hpp"

#include <cmath>

namespace ckc {

// Change of the energy, relative to the change that errors within the tolerances cause, above which a step is wrong.
constexpr double max_relative_change = 100.0;

double EnergyMonitor::energy(System& system) {
  Core& core = system.core;
  const bool dissipates = core.springs.has_damping || core.joints.exerts_force();
  if (!system.conserves_energy() || system.control.is_active() || system.forces() || dissipates) return std::nan("");
  const Energy energy = core.energy(system.velocity, momentum_);
  size_ = energy.kinetic + std::abs(energy.potential);
  return energy.total();
}

void EnergyMonitor::start_step(System& system) { start_energy_ = end_energy_ = energy(system); }

// A state within its tolerance has errors atol + rtol |x|. The energy then has these errors times its gradient: the
// momentum and the bias forces.
bool EnergyMonitor::is_kept(System& system, double rtol, double atol) {
  end_energy_ = energy(system);
  if (std::isnan(start_energy_) || std::isnan(end_energy_)) return true;
  Core& core = system.core;
  double allowance = rounding * size_;
  for (int k = 0; k < core.n; ++k)
    allowance += std::abs(momentum_(k)) * (atol + rtol * std::abs(system.velocity(k)));
  change = end_energy_ - start_energy_;
  if (std::abs(change) <= max_relative_change * allowance) return true;
  core.set_velocity(system.velocity), core.compute_bias();
  for (int k = 0; k < core.n; ++k)
    allowance += std::abs(core.bias_tree(k)) * (atol + rtol * std::abs(core.q_tree(core.tree.q_index[k])));
  return !(std::abs(change) > max_relative_change * allowance);
}

bool EnergyMonitor::is_kept(const StepEnd& end) {
  if (std::isnan(start_energy_)) return true;
  end_energy_ = end.energy, change = end_energy_ - start_energy_;
  return std::abs(change) <= max_relative_change * end.energy_allowance;
}

}  // namespace ckc
