// Explicit Runge-Kutta methods: DOP853, and RK45 for stretches so short that the other's twelve stages do not pay.
#pragma once

#include "motion/method.hpp"

namespace ckc {

class Explicit : public Method {
 public:
  enum Kind { dop853, rk45 };
  Explicit(Kind kind, System& system, Step& step, Work& work, const Tolerance& tolerance);

  bool step(double t_bound) override;
  bool between(double t, Out y) override;
  void retry(double length) override;
  void commit() override;
  void forget() override { growth_pending_ = false; }
  const char* name() const override { return kind_ == dop853 ? "DOP853" : "RK45"; }
  int error_order() const override { return kind_ == dop853 ? 7 : 4; }
  // How long steps of order five may be, as the last one's error tells.
  double reach_of_order_five() const { return reach_; }

 private:
  bool stages(double h);
  double error(double h);
  bool extra_stages(double h);

  const Kind kind_;
  int stages_;
  Matrix A_, A_extra_, D_;  // D_: of the dense output
  Vector B_, C_, C_extra_, E_[2];
  Matrix K_, F_;  // (size, stages), (size, powers)
  Matrix X_;      // rates of the whole motion, (whole size, stages)
  Vector y_stage_, scale_, error_;
  Vector x_stage_;
  bool dense_ = false, growth_pending_ = false, growth_next_ = false;
  double reach_ = 0.0;
};

}  // namespace ckc
