#include "record.hpp"

namespace ckc {

Record::Record(const Core& core) : width(5 + 2 * core.n + core.d + 2 * core.rows.closure.rows) {
  product_.setZero(core.n);
}

bool Record::row(System& system, double t, In y, Out row) {
  Core& core = system.core;
  const int n = core.n, d = core.d, m = core.rows.closure.rows;
  if (!system.exact(t, y)) return false;
  core.inertia();
  core.bias(system.v_tree);
  core.D_times(system.v_tree, product_);
  const double kinetic = 0.5 * system.v_tree.dot(product_);
  system.drive.act(t, core, system.q, system.q_dot);
  const double potential = core.tree.potential_energy(core.q_tree) + core.springs.energy(core.tree, core.q_tree);
  row(0) = t;
  core.tree.to_coordinates(core.q_tree, row.segment(1, n));
  row.segment(1 + n, n) = system.velocity;
  row.segment(1 + 2 * n, d) = system.drive.tau;
  row.segment(1 + 2 * n + d, m) = core.rows.phi;
  row.segment(1 + 2 * n + d + m, m) = system.w;
  auto last = row.tail<4>();
  last(0) = kinetic + potential;
  last(1) = system.drive.controls()
                ? system.drive.lyapunov(core, potential, system.q, system.q_dot, core.rows.phi)
                : 0.0;
  last(2) = last(3) = 0.0;
  for (int i = 0; i < m; ++i) {
    last(2) = std::max(last(2), std::abs(core.rows.phi(i) - system.w(i)));
    last(3) = std::max(last(3), std::abs(core.rows.J.row(i).dot(system.velocity) - system.decay() * system.w(i)));
  }
  return row.allFinite();
}

}  // namespace ckc
