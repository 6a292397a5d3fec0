// Eq. 8 as printed, y = (q, q_dot, z). Trees without free roots only.
#pragma once

#include "system.hpp"

namespace ckc {

class PrintedSpf : public System {
 public:
  PrintedSpf(Core& core, double epsilon, bool actual, In w0);

  bool rhs(double t, In y, Out y_dot) override;
  bool exact(double t, In y) override;
  bool at_last(double t, In y) override { return exact(t, y); }
  bool accept(double, Out, bool& changed) override { return changed = false, true; }
  double decay() const override { return -1.0 / epsilon_; }

 private:
  void place(double t, In y);  // the core at the state; z_dot_ with phi as it is

  double epsilon_;
  bool actual_;
  Vector w0_, q_tree_, z_dot_;
};

}  // namespace ckc
