// Eq. 8 as printed in the paper, y = (q, q_dot, z). Only for trees without free roots.
#pragma once

#include "motion/system.hpp"

namespace ckc {

class PrintedSpf : public System {
 public:
  PrintedSpf(Core& core, Control& control, double epsilon, bool actual);

  void start(double t, In q_tree, In v_tree, In w, Out y) override;
  bool sync_motion(double t, In y) override;
  bool sync_motion_at_last_rhs(double t, In y) override { return sync_core(t, y); }
  double coordinate_margin() override { return phi_z_margin(); }
  Accepted accept_motion(double t, Out y, double margin) override;
  void rate_pairs(std::vector<std::pair<int, int>>& of) const override {
    of.clear();
    for (int k = 0; k < core.d; ++k) of.emplace_back(k, core.d + k);
  }
  double w_decay_rate() const override { return -1.0 / epsilon_; }
  bool tree_acceleration(In, Out) const override { return false; }
  void add_motion_velocity(Out, In) const override {}  // this formulation does not support friction and stops
  void add_motion_displacement(Out, In) const override {}

 private:
  bool motion_rhs(double t, In y, Out y_dot) override;
  void set_state(double t, In y);  // sets the core, and z_dot_ by eq. 8 with the actual phi

  const double epsilon_;
  const bool actual_;
  double t_start_ = 0.0;
  Vector w0_, q_tree_, z_dot_;
};

}  // namespace ckc
