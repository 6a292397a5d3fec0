// Eq. 8 as printed, y = (q, q_dot, z). Trees without free roots only.
#pragma once

#include "motion/system.hpp"

namespace ckc {

class PrintedSpf : public System {
 public:
  PrintedSpf(Core& core, Control& control, double epsilon, bool actual);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool rhs(double t, In y, Out y_dot) override;
  bool exact(double t, In y) override;
  bool at_last(double t, In y) override { return exact(t, y); }
  double margin() override { return phi_z_margin(); }
  Accepted accept(double t, Out y, double margin) override;
  void rates(std::vector<std::pair<int, int>>& of) const override {
    of.clear();
    for (int k = 0; k < core.d; ++k) of.emplace_back(k, core.d + k);
  }
  double decay() const override { return -1.0 / epsilon_; }
  bool tree_acceleration(In, Out) const override { return false; }
  void push(Out, In) const override {}  // joints of such a motion neither rub nor stop
  void shift(Out, In) const override {}

 private:
  void place(double t, In y);  // the core at the state; z_dot_ with phi as it is

  const double epsilon_;
  const bool actual_;
  double t_start_ = 0.0;
  Vector w0_, q_tree_, z_dot_;
};

}  // namespace ckc
