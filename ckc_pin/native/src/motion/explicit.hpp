// Explicit Runge-Kutta methods: DOP853, and RK45 for segments too short for its twelve stages.
#pragma once

#include "motion/method.hpp"

namespace ckc {

class Explicit : public Method {
 public:
  enum Kind { dop853, rk45 };
  Explicit(Kind kind, System& system, Step& step, Work& work, const Tolerance& tolerance);

  bool make_step(double t_bound) override;
  bool interpolate(double t, Out y) override;
  void reject_step(double step_size) override;
  void accept_step() override;
  void reset_history() override { growth_pending_ = false, computed_h_ = 0.0; }
  const char* name() const override { return kind_ == dop853 ? "DOP853" : "RK45"; }
  int error_order() const override { return kind_ == dop853 ? 7 : 4; }
  // Size of the next step that `make_step` will try first.
  double next_step_size(double t_bound) const;
  // Step size of RK45, estimated from the error of the last step.
  double order_five_step_size() const { return order_five_step_; }

 private:
  friend class Lanes;
  bool stages(double h);
  bool take_computed_stages();
  double error(double h);
  bool extra_stages(double h);

  const Kind kind_;
  int stages_;
  Matrix A_, A_extra_, D_;  // D_: dense output
  Vector B_, C_, C_extra_, E_[2];
  Matrix K_;  // rates at the stages, (size, stages)
  Matrix F_;  // coefficients of the dense output, (size, powers)
  Matrix X_;  // rates of the full motion at the stages, (full motion size, stages)
  Vector y_stage_, x_stage_, scale_, error_;
  double computed_t_ = 0.0, computed_h_ = 0.0;  // step whose stages were computed with those of others (Lanes), if h > 0
  bool has_dense_output_ = false;
  // Whether the last accepted step, and the new one, ask for a growth of more than max_single_growth.
  bool growth_pending_ = false, growth_next_ = false;
  double order_five_step_ = 0.0;
};

}  // namespace ckc
