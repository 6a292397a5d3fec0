// Eq. 1 as a DAE, y = (q', v'): put back on the closure after each step, or held near it by Baumgarte's terms.
#pragma once

#include "system.hpp"

namespace ckc {

class Dae : public System {
 public:
  // `alpha`, `beta` of Baumgarte's stabilisation, zero for none.
  Dae(Core& core, double tolerance, bool projects, double alpha, double beta);

  bool rhs(double t, In y, Out y_dot) override;
  bool exact(double t, In y) override;
  bool at_last(double t, In y) override;
  bool place(In y) override;
  bool accept(double t, Out y, bool& changed) override;
  // `rhs` at y put on the closure to rounding, along every direction, however weakly J determines it.
  bool rate_on_closure(double t, In y, Out y_dot);
  // Into core.q_tree and velocity, by the shortest steps in the metric of the inertia; false also where J is nearly
  // singular, which Python closes with care.
  bool project(In y);

 private:
  void set(In q_tree, bool with_inertia = true);  // the core at a configuration, with D' and what controllers need
  void independent(In v);  // q of the core's configuration, and q_dot
  bool rate(double t, In v, Out y_dot);  // at the core's configuration

  double tolerance_, alpha_, beta_;
  bool projects_;
  long placed_ = -1;  // core.sets, when it was done here
  Vector q_tree_, step_, residual_;
};

}  // namespace ckc
