// Eq. 1 as a DAE, y = (q', v'): put back on the closure after each step, or held near it by Baumgarte's terms.
#pragma once

#include "motion/system.hpp"

namespace ckc {

class Dae : public System {
 public:
  // `alpha`, `beta` of Baumgarte's stabilisation, zero for none.
  Dae(Core& core, Control& control, double tolerance, bool projects, double alpha, double beta);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool rhs(double t, In y, Out y_dot) override;
  bool exact(double t, In y) override;
  bool at_start(double t, In y) override;
  bool at_last(double t, In y) override;
  bool as_is(double t, In y) override;
  bool shows(In y, int k, bool rate, double& value) const override;
  void put_exact(Out y) const override;
  bool place(In y) override;
  Accepted accept(double t, Out y, double margin) override;
  void rates(std::vector<std::pair<int, int>>& of) const override;
  bool conserves() const override { return projects_; }
  bool jacobian(double t, In y, Matrix& jacobian, long& evaluations) override;
  bool modes(In y, Matrix& jacobian) override;
  bool tree_acceleration(In f, Out a) const override { return a = f.tail(core.n), true; }
  void push(Out y, In v) const override { y.tail(core.n) += v; }
  void shift(Out y, In step) const override { core.tree.integrate(y.head(core.tree.nq), step); }
  // `rhs` at y put on the closure to rounding, along every direction, however weakly J determines it.
  bool rate_on_closure(double t, In y, Out y_dot);

 protected:
  Vector q_tree_;  // where a right-hand side was evaluated last

 private:
  void set(In q_tree, bool with_inertia = true);  // the core at a configuration, with J
  void independent(In q_tree, In v);              // q, q_dot
  bool forces(double t, In q_tree, In v);         // what acts there
  bool stabilised() const { return alpha_ != 0.0 || beta_ != 0.0; }
  bool rate(double t, In v, Out y_dot);           // at the core's configuration
  // Into core.q_tree and velocity. Where nothing is controlled, by the shortest steps in the metric of the inertia: the
  // correction with the least work on the motion.
  bool project(In y);
  bool closing_step(In residual);  // into step_

  const double tolerance_, alpha_, beta_;
  const bool projects_;
  long placed_ = -1;  // core.sets, when it was done here
  Vector step_, z_step_, residual_, unforced_;
  Matrix more_;
};

}  // namespace ckc
