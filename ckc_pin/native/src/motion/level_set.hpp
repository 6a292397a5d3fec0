// The reduced model, eq. 6, on a level set of phi; with w(t) of eq. 17 that is the SPF. y = (q in a chart, q_dot).
#pragma once

#include "loops/closure_solver.hpp"
#include "loops/partition.hpp"
#include "loops/predictor.hpp"
#include "motion/system.hpp"

namespace ckc {

class LevelSet : public System {
 public:
  // A right-hand side may be off the level set by `slack`, which an integrator of a given tolerance does not notice.
  LevelSet(Core& core, Control& control, double epsilon, bool actual, double tolerance, double slack);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool rhs(double t, In y, Out y_dot) override;
  bool exact(double t, In y) override { return state(t, y, tolerance_); }
  bool at_start(double t, In y) override;
  bool at_last(double t, In y) override;
  bool shows(In y, int k, bool rate, double& value) const override;
  double margin() override { return phi_z_margin(); }
  Accepted accept(double t, Out y, double margin) override;
  bool own_partition(double t, Out y, bool& changed) override;
  bool jacobian(double t, In y, Matrix& jacobian, long& evaluations) override;
  void rates(std::vector<std::pair<int, int>>& of) const override;
  double decay() const override { return -1.0 / epsilon_; }
  double layer() const override { return on_manifold_ ? System::layer() : epsilon_; }
  bool tree_acceleration(In f, Out a) const override;
  void push(Out y, In v) const override;
  void shift(Out y, In step) const override;
  void go_on(double t, Out y) override;
  bool conserves() const override { return on_manifold_; }
  bool return_to_accepted() override;
  // (q', v'), off the manifold (q', q_dot), while a step resolves how w decays.
  int whole_size() const override { return core.rank ? core.tree.nq + (on_manifold_ ? core.n : core.d) : 0; }
  double whole_within() const override { return on_manifold_ ? System::whole_within() : epsilon_; }
  void whole(In f, Out x, Out x_dot) const override;
  void add_rounding(In x, Out scale) const override;

 private:
  void level(double t);
  void predict_from_accepted();
  void begin(In q_tree);  // coordinates and predictor, with the core's partition
  // Close z at y, then rho and the tree's velocities; false where Newton's method does not get there.
  bool state(double t, In y, double tolerance);
  bool close(double tolerance);  // from q_tree_
  bool exact_jacobian(double t, In y, Matrix& jacobian);
  bool move_to(const Partition& partition, double t, Out y);
  void chart_numbers(Out y);

  const double epsilon_, tolerance_, slack_;
  const bool actual_;
  const Partition own_;
  bool on_manifold_ = true;
  // How often the rates of z have disagreed in these coordinates: the loops are closed without slack then, and after
  // that to rounding. Of the balance, the time since counts against it, in steps as they were before.
  int refusals_ = 0;
  bool to_rounding_ = false;  // loops are closed so whatever came before
  double balance_ = 0.0, length_ = 0.0, accepted_ = 0.0;
  double t_start_ = 0.0;
  double alarm_;      // margin at which a better q is looked for
  Chart chart_;
  Predictor predictor_;
  Closing closing_;
  Vector anchor_, arrived_;  // configurations of the last accepted state, and of the one that may be next
  Vector w0_, q_tree_, residual_, z_, step_;
  bool of_tree_ = false;  // whether a_tree_ is that of the last right-hand side
  Vector a_tree_, unit_;
  Matrix rho_dot_;
};

}  // namespace ckc
