// Eq. 1 as a DAE with y = (q', v'). It is projected onto the constraint manifold after each step, or stabilized by
// Baumgarte's method.
#pragma once

#include "motion/system.hpp"

namespace ckc {

class Dae : public System {
 public:
  static constexpr int max_newton_steps = 10;
  static constexpr double rate_rounding = 2e-16;  // relative error of |J v'| that is not corrected
  // `alpha`, `beta`: parameters of Baumgarte's stabilization, zero without it.
  Dae(Core& core, Control& control, double tolerance, bool projects, double alpha, double beta);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool sync_motion(double t, In y) override;
  bool sync_core_at_start(double t, In y) override;
  bool sync_motion_at_last_rhs(double t, In y) override;
  bool sync_motion_unprojected(double t, In y) override;
  bool read_from_state(In y, int k, bool of_rate, double& value) const override;
  void write_projected_state(Out y) const override;
  bool set_core_configuration(In y) override;
  Accepted accept_motion(double t, Out y, double margin) override;
  void rate_pairs(std::vector<std::pair<int, int>>& of) const override;
  double projection_tolerance() const override {
    return projects_ && !control.is_active() && !elimination.is_due() ? tolerance_ : 0.0;
  }
  bool conserves_energy() const override { return projects_ && !core.has_row_motion(); }
  bool reduce_to_freedoms(In y, Matrix& jacobian) override;
  const Vector& configuration_at_last_rhs() const override { return q_tree_; }
  const CompiledTerms* terms_of_rate() const override;
  bool force_of_rate(double t, In q_tree, In v, Out force) override;
  void set_last_rhs(In y) override { q_tree_ = y.head(core.tree.nq), v_tree = velocity_in(y); }
  void move_core_to_last_rhs(In y) override;
  bool tree_acceleration(In f, Out a) const override { return a = velocity_in(f), true; }
  void add_motion_velocity(Out y, In v) const override { y.segment(core.tree.nq, core.n) += v; }
  void add_motion_displacement(Out y, In step) const override { core.tree.integrate(y.head(core.tree.nq), step); }
  bool rate_on_manifold(double t, In y, Out y_dot) override;

 private:
  bool needs_core() const;  // whether the rate needs more than compiled terms
  bool motion_rhs(double t, In y, Out y_dot) override;
  bool motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations) override;
  Eigen::Ref<const Vector> velocity_in(In y) const { return y.segment(core.tree.nq, core.n); }
  void set_core(In q_tree, bool with_inertia = true);  // to a configuration, with J
  void set_q_and_q_dot(In q_tree, In v);
  bool compute_forces(double t, In q_tree, In v);  // evaluates the control
  bool is_stabilized() const { return alpha_ != 0.0 || beta_ != 0.0; }
  bool evaluate_rate(double t, In v, Out y_dot);  // at the core's configuration
  // Project y; the result is core.q_tree and `velocity`. Without control, corrections are minimum-norm in the metric of
  // the inertia, which disturbs the motion as little as possible.
  bool project_onto_manifold(In y);
  bool closure_step(In residual);  // sets step_
  void add_stabilization(In v);    // Baumgarte's terms, to residual_
  void set_rate_residual(In v);    // residual_ = phi_dot
  bool is_core_at_state() const;

  const double tolerance_, alpha_, beta_;
  const bool projects_;
  long core_configuration_ = -1;  // core.configuration_count when this object last set the core; -1: without inertia
  long core_row_version_ = 0;     // `row_version` then
  Vector q_tree_;                 // configuration of the last right-hand side
  Vector step_, z_step_, residual_, no_force_, phi_dot_;
  Matrix stabilization_;
};

}  // namespace ckc
