#include "motion/recorder.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

static int width_of(const System& system) {
  const Core& core = system.core;
  return 6 + 2 * core.n + core.d + static_cast<int>(system.control.tau.size()) + 2 * core.rows.closure.rows + system.extra();
}

Recorder::Recorder(const System& system) : width(width_of(system)) { momentum_.setZero(system.core.n); }

void Recorder::begin(Vector instants, double* rows, Eigen::Index most) {
  instants_ = std::move(instants), rows_ = rows, most_ = most, next_ = filled = 0;
}

bool Recorder::add(System& system, double t, In y) {
  if (full() || (filled && t <= rows_[(filled - 1) * width])) return true;
  Eigen::Map<Vector> place(rows_ + filled * width, width);
  if (!row(system, t, y, place)) return false;
  ++filled;
  return true;
}

bool Recorder::row(System& system, double t, In y, Out row) {
  Core& core = system.core;
  const int n = core.n, d = core.d, m = core.rows.closure.rows;
  const auto actuators = system.control.tau.size();
  if (!system.exact(t, y)) return false;
  const Energy energy = core.energy(system.v_tree, momentum_);
  core.set_velocity(system.v_tree);
  if (!system.act(t)) return false;
  system.control.settle_u(core);
  Eigen::Index at = 0;
  const auto put = [&](In part) { row.segment(at, part.size()) = part, at += part.size(); };
  row(at++) = t;
  core.tree.to_coordinates(core.q_tree, row.segment(at, n)), at += n;
  put(system.velocity), put(system.control.u.head(d)), put(system.control.tau.head(actuators));
  put(core.rows.phi), put(system.w);
  row(at++) = energy.total();
  row(at++) = core.joints.dissipated(row.segment(1, n));
  row(at++) = system.control.lyapunov(system.measured(t), energy.potential, core.rows.phi);
  double open = 0.0, opening = 0.0;
  for (int i = 0; i < m; ++i) {
    open = std::max(open, std::abs(core.rows.phi(i) - system.w(i)));
    opening = std::max(opening, std::abs(core.rows.J.row(i).dot(system.velocity) - system.decay() * system.w(i)));
  }
  row(at++) = open, row(at++) = opening;
  system.put_extra(y, row.tail(system.extra()));
  return std::isfinite(energy.total()) && row.head(1 + 2 * n).allFinite();
}

}  // namespace ckc
