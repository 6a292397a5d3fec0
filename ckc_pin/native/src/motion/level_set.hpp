// The reduced model, eq. 6, on a level set phi = w. With w(t) of eq. 17 it is the SPF. y = (q in a chart, q_dot).
#pragma once

#include "loops/closure_solver.hpp"
#include "loops/partition.hpp"
#include "loops/predictor.hpp"
#include "motion/system.hpp"

namespace ckc {

class LevelSet : public System {
 public:
  // `rhs_tolerance`: tolerance on |phi - w| in right-hand sides, small enough for the integrator's tolerance.
  LevelSet(Core& core, Control& control, double epsilon, bool actual, double tolerance, double rhs_tolerance);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool sync_motion(double t, In y) override { return project_state(t, y, tolerance_); }
  bool sync_core_at_start(double t, In y) override;
  bool sync_motion_at_last_rhs(double t, In y) override;
  bool read_from_state(In y, int k, bool of_rate, double& value) const override;
  double coordinate_margin() override { return phi_z_margin(); }
  Accepted accept_motion(double t, Out y, double margin) override;
  bool restore_partition(double t, Out y, bool& changed) override;
  void rate_pairs(std::vector<std::pair<int, int>>& of) const override;
  double w_decay_rate() const override { return -1.0 / epsilon_; }
  double boundary_layer_time() const override { return on_manifold_ ? System::boundary_layer_time() : epsilon_; }
  bool tree_acceleration(In f, Out a) const override;
  void add_motion_velocity(Out y, In v) const override;
  void add_motion_displacement(Out y, In step) const override;
  void resume(double t, Out y) override;
  bool conserves_energy() const override { return on_manifold_ && !core.has_row_motion(); }
  bool return_to_accepted() override;
  // (q', v'), or (q', q_dot) off the manifold while a step resolves the decay of w.
  int full_motion_size() const override { return core.rank ? core.tree.nq + (on_manifold_ ? core.n : core.d) : 0; }
  double full_motion_max_step() const override { return on_manifold_ ? System::full_motion_max_step() : epsilon_; }
  void full_motion(In f, Out x, Out x_dot) const override;
  void add_rounding(In x, Out scale) const override;

 private:
  bool motion_rhs(double t, In y, Out y_dot) override;
  bool motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations) override;
  void project_exactly(bool on) override { project_to_rounding_ = on; }  // rhs_tolerance_ exceeds difference steps
  void update_w(double t);
  void predict_from_accepted();
  void reset_coordinates(In q_tree);  // chart, predictor and margins for the core's partition
  // Project the state at y, then compute rho and velocities. False if Newton's method fails.
  bool project_state(double t, In y, double tolerance);
  bool project_from_predicted(double tolerance);  // from q_tree_
  bool exact_jacobian(double t, In y, Matrix& jacobian);
  bool change_partition(const Partition& partition, double t, Out y);
  void write_chart_coordinates(Out y);

  const double epsilon_, tolerance_, rhs_tolerance_;
  const bool actual_;
  const Partition fixed_partition_;
  bool on_manifold_ = true;
  // How often z has disagreed with its integrated rates in these coordinates. After the first time, right-hand sides
  // are projected to the full tolerance; after the second, to rounding.
  int disagreements_ = 0;
  bool project_to_rounding_ = false;  // regardless of disagreements
  // Each disagreement increases the balance, and each accepted step decreases it by its size over the usual step size.
  double rejection_balance_ = 0.0, usual_step_ = 0.0;
  double accepted_t_ = 0.0, t_start_ = 0.0;  // s
  double search_margin_;                     // coordinate margin below which a better q is searched for
  Chart chart_;
  Predictor predictor_;
  ClosureSolver closure_solver_;
  Vector accepted_q_tree_, last_q_tree_;  // q' of the last accepted state, and of the end of the last step
  Vector w0_, q_tree_, residual_, z_, step_;
  bool has_tree_acceleration_ = false;  // whether a_tree_ belongs to the last right-hand side
  Vector a_tree_, unit_q_dot_;
  Matrix rho_dot_;
};

}  // namespace ckc
