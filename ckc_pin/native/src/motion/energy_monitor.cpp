#include "motion/energy_monitor.hpp"

#include <cmath>

namespace ckc {

constexpr double rounding = 1e-13;  // of the energy, relative to |kinetic| + |potential|

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
double EnergyMonitor::relative_change(System& system, double rtol, double atol) {
  end_energy_ = energy(system);
  if (std::isnan(start_energy_) || std::isnan(end_energy_)) return 0.0;
  Core& core = system.core;
  core.set_velocity(system.velocity), core.compute_bias();
  double allowance = rounding * size_;
  for (int k = 0; k < core.n; ++k)
    allowance += std::abs(momentum_(k)) * (atol + rtol * std::abs(system.velocity(k))) +
                 std::abs(core.bias_tree(k)) * (atol + rtol * std::abs(core.q_tree(core.tree.q_index[k])));
  change = end_energy_ - start_energy_;
  return std::abs(change) / allowance;
}

}  // namespace ckc
