#include "motion/printed_spf.hpp"

#include <cmath>

namespace ckc {

PrintedSpf::PrintedSpf(Core& core_, Control& control_, double epsilon, bool actual)
    : System(core_, control_, core_.n + core_.d), epsilon_(epsilon), actual_(actual) {
  q_tree_.setZero(core.n), z_dot_.setZero(core.z.size()), w0_.setZero(core.constraints.closure.rows);
}

void PrintedSpf::start(double t, In q_tree, In v, In w_start, Out y) {
  t_start_ = t, w0_ = w_start;
  for (int k = 0; k < core.d; ++k) y(k) = q_tree(core.tree.q_index[core.q[k]]), y(core.d + k) = v(core.q[k]);
  for (size_t k = 0; k < core.z.size(); ++k) y(2 * core.d + k) = q_tree(core.tree.q_index[core.z[k]]);
}

void PrintedSpf::set_state(double t, In y) {
  const int d = core.d;
  for (int k = 0; k < d; ++k) q_tree_(core.tree.q_index[core.q[k]]) = y(k);
  for (size_t k = 0; k < core.z.size(); ++k) q_tree_(core.tree.q_index[core.z[k]]) = y(2 * d + k);
  core.set_configuration(q_tree_, true);
  core.compute_rho();
  q = y.head(d), q_dot = y.segment(d, d);
  w = w0_ * std::exp(-(t - t_start_) / epsilon_);
  core.spf_z_dot(q_dot, epsilon_, core.constraints.phi, z_dot_);
  core.multiply_rho(q_dot, v_tree);
  if (!actual_) return;
  for (size_t k = 0; k < core.z.size(); ++k) v_tree(core.z[k]) = z_dot_(k);
}

// The velocity uses the exact w: the error of phi within the tolerance would be divided by epsilon.
bool PrintedSpf::sync_motion(double t, In y) {
  if (!y.allFinite()) return false;
  set_state(t, y);
  core.multiply_rho(q_dot, velocity);
  core.spf_z_dot(q_dot, epsilon_, w, z_dot_);
  for (size_t k = 0; k < core.z.size(); ++k) velocity(core.z[k]) = z_dot_(k);
  return true;
}

Accepted PrintedSpf::accept_motion(double, Out, double margin) {
  return margin > chart_margin ? Accepted::unchanged : Accepted::rejected;
}

bool PrintedSpf::motion_rhs(double t, In y, Out y_dot) {
  const int d = core.d;
  if (!y.allFinite()) return fail(RhsFailure::not_finite);
  set_state(t, y);
  core.set_velocity(v_tree);
  if (!compute_control(t)) return false;
  counts.factorizations += 2;
  y_dot.head(d) = q_dot;
  const Vector& force = applied_force(v_tree);
  if (actual_)
    core.actual_acceleration(force, q_dot, y_dot.segment(d, d));
  else
    core.reduced_acceleration(force, y_dot.segment(d, d));
  y_dot.tail(z_dot_.size()) = z_dot_;
  return y_dot.allFinite() || fail(RhsFailure::not_finite);
}

}  // namespace ckc
