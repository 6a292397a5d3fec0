#include "motion/recorder.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

// The same order as in `fill_row`.
static std::vector<RecordColumns> columns_of(const System& system) {
  const Core& core = system.core;
  const Eigen::Index n = core.n, rows = core.constraints.closure.rows;
  const std::pair<const char*, Eigen::Index> sizes[] = {
      {"t", 1},
      {"q_tree", n},
      {"v_tree", n},
      {"u", core.d},
      {"tau", system.control.tau.size()},
      {"phi", rows},
      {"w", rows},
      {"energy", 1},
      {"dissipated", 1},
      {"lyapunov", 1},
      {"max_phi", 1},
      {"max_phi_dot", 1},
      {"forces", system.forces() ? system.forces()->wrenches.size() : 0},
      {"works", system.integrates_works() ? work_count + 1 : 0},  // those of `WorkOf`, then of impacts
      {"prescribed", 2 * static_cast<Eigen::Index>(system.prescribed_joints().size())},
      {"extra", system.integrand ? system.integrand->record_size() : 0},
  };
  std::vector<RecordColumns> columns;
  Eigen::Index begin = 0;
  for (const auto& [name, size] : sizes) {
    columns.push_back({name, begin, begin + size});
    begin += size;
  }
  return columns;
}

Recorder::Recorder(const System& system) : columns(columns_of(system)), width(columns.back().end) {
  momentum_.setZero(system.core.n), phi_dot_.setZero(system.core.constraints.closure.rows);
}

void Recorder::start(Vector instants, double* rows, Eigen::Index max_rows) {
  instants_ = std::move(instants), rows_ = rows, max_rows_ = max_rows, next_ = filled = 0;
}

bool Recorder::add(System& system, double t, In y) {
  if (is_full() || (filled && t <= rows_[(filled - 1) * width])) return true;
  Eigen::Map<Vector> row(rows_ + filled * width, width);
  if (!fill_row(system, t, y, row)) return false;
  ++filled;
  return true;
}

bool Recorder::fill_row(System& system, double t, In y, Out row) {
  Core& core = system.core;
  const int n = core.n, d = core.d, m = core.constraints.closure.rows;
  const auto actuators = system.control.tau.size();
  if (!system.sync_core(t, y)) return false;
  const Energy energy = core.energy(system.v_tree, momentum_);
  core.set_velocity(system.v_tree);
  if (!system.compute_control(t)) return false;
  system.control.recover_u(core);
  Eigen::Index at = 0;
  const auto append = [&](In part) { row.segment(at, part.size()) = part, at += part.size(); };
  row(at++) = t;
  core.tree.to_coordinates(core.q_tree, row.segment(at, n)), at += n;
  append(system.velocity), append(system.control.u.head(d)), append(system.control.tau.head(actuators));
  if (!system.prescribed_joints().empty() && !system.set_prescribed_torques(t, row.segment(at - actuators, actuators)))
    return false;
  append(core.constraints.phi), append(system.w);
  row(at++) = energy.total();
  row(at++) = core.joints.dissipated_energy(row.segment(1, n));
  row(at++) = system.control.lyapunov(system.measured(t), energy.potential, core.constraints.phi);
  double max_phi_error = 0.0, max_phi_dot_error = 0.0;
  core.constraints.multiply_J(system.velocity, phi_dot_);
  for (int i = 0; i < m; ++i) {
    max_phi_error = std::max(max_phi_error, std::abs(core.constraints.phi(i) - system.w(i)));
    max_phi_dot_error =
        std::max(max_phi_dot_error, std::abs(phi_dot_(i) - system.w_decay_rate() * system.w(i) -
                                             (core.has_row_motion() ? core.row_motion.rate(i) : 0.0)));
  }
  row(at++) = max_phi_error, row(at++) = max_phi_dot_error;
  if (system.forces()) append(system.forces()->wrenches);
  if (system.integrates_works()) append(system.works(y)), row(at++) = -core.joints.impact_loss;
  for (const PrescribedJoint& joint : system.prescribed_joints())
    row(at++) = joint.acceleration, row(at++) = joint.is_free ? 0.0 : 1.0;
  if (system.integrand) system.integrand->fill_record(y, row.tail(width - at));
  return std::isfinite(energy.total()) && row.head(1 + 2 * n).allFinite();
}

}  // namespace ckc
