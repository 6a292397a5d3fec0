#include "motion/system.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double difference = 1.5e-8;  // step of forward differences, relative, or rad, m, and their rates

System::System(Core& core_, Control& control_, int size_) : core(core_), control(control_), size(size_) {
  velocity.setZero(core.n), v_tree.setZero(core.n), w.setZero(core.rows.closure.rows);
  q.setZero(core.d), q_dot.setZero(core.d);
  acting_.setZero(core.n), uncorrected_.setZero(core.rows.closure.rows), drift_.setZero(core.n), back_.setZero(core.n);
}

const Vector& System::acting(In v) {
  if (!core.joints.acts()) return control.u_tree;
  acting_ = control.u_tree;
  core.joints.add_friction(v, acting_);
  return acting_;
}

bool System::eq_1(In v, In correction, Out a) {
  return core.eq_1(acting(v), correction, a) || fails(Trouble::rank);
}

bool System::slopes(In q_tree, In v, In correction, Matrix& by_q, Matrix& by_v) {
  if (!control.acts() && !core.joints.smooth()) {  // nothing that answers to the state
    force_ = control.u_tree;
    return core.slopes(q_tree, v, correction, force_, none_, none_, a_, by_q, by_v) || fails(Trouble::rank);
  }
  if (!control.slopes(core, u_by_q_, u_by_v_, force_)) return false;
  return core.slopes(q_tree, v, correction, force_, u_by_q_, u_by_v_, a_, by_q, by_v) || fails(Trouble::rank);
}

bool System::acceleration(double t, Out a) {
  core.set_velocity(velocity);
  return act(t) && eq_1(velocity, uncorrected_, a);
}

bool System::keep_locked(Out y, double tolerance, bool& changed) {
  Joints& joints = core.joints;
  changed = false;
  core.tree.to_coordinates(core.q_tree, drift_);
  drift_ -= joints.place;
  double off = 0.0, rate = 0.0;
  for (int k : joints.locked) {
    off = std::max(off, std::abs(drift_(k)) / joints.table.reach(k));
    rate = std::max(rate, std::abs(velocity(k)) / joints.table.reach(k));
  }
  if (!(off > tolerance) && !(rate > tolerance)) return true;
  if (!core.responses(joints.locked, responses_)) return false;
  changed = true;
  joints.back(responses_, drift_, back_), shift(y, back_);
  joints.back(responses_, velocity, back_), push(y, back_);
  return y.allFinite();
}

double System::phi_z_margin() {
  if (!core.rank) return std::numeric_limits<double>::infinity();
  if (!phi_z_) {
    std::vector<Indices> pattern(core.rows.closure.rows);
    for (size_t i = 0; i < pattern.size(); ++i)
      for (int j : core.rows.pattern[i])
        if (std::find(core.z.begin(), core.z.end(), j) != core.z.end()) pattern[i].push_back(j);
    phi_z_ = std::make_unique<Spectrum>(std::move(pattern), core.n, core.rank);
  }
  core.jacobian();
  const Vector &rows = core.scales.rows, &columns = core.scales.columns;
  phi_z_->compute(core.rows.J, rows, columns);
  double square = 0.0;
  for (int i = 0; i < core.rows.closure.rows; ++i)
    for (int j : core.rows.pattern[i]) {
      const double scaled = rows(i) * core.rows.J(i, j) * columns(j);
      square += scaled * scaled;
    }
  return phi_z_->least() / std::max(std::sqrt(square), 1e-300);
}

bool System::jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  const auto size = y.size();
  jacobian.resize(size, size), rate_.resize(size), rate_here_.resize(size);
  moved_ = y;
  ++evaluations, ++counts.differences;
  if (!moves(t, moved_, rate_here_)) return false;
  for (Eigen::Index k = 0; k < size; ++k) {
    moved_(k) = y(k) + difference * std::max(1.0, std::abs(y(k)));
    const double step = moved_(k) - y(k);
    ++evaluations;
    if (!moves(t, moved_, rate_)) return false;
    jacobian.col(k) = (rate_ - rate_here_) / step;
    moved_(k) = y(k);
  }
  return jacobian.allFinite();
}

}  // namespace ckc
