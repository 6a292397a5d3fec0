// Explicit Runge-Kutta methods: DOP853, and RK45 for segments too short for its twelve stages.
#pragma once

#include "motion/method.hpp"
#include "motion/step_end.hpp"

namespace ckc {

class Explicit : public Method {
 public:
  enum Kind { dop853, rk45 };
  // The next step: its method, the time that it must not exceed, and whether the rate at its start is known.
  struct Attempt {
    Explicit* method = nullptr;
    double bound = 0.0;
    bool rate_is_known = false;
    StepEnd* end = nullptr;  // to compute with it; null if the step loop has to do that
  };
  Explicit(Kind kind, System& system, Step& step, Work& work, const Tolerance& tolerance);

  bool make_step(double t_bound) override;
  bool interpolate(double t, Out y) override;
  void reject_step(double step_size) override;
  void accept_step() override;
  void reset_history() override { growth_pending_ = start_is_computed_ = false, computed_.h = repeat_size_ = 0.0; }
  bool is_repeating() const override { return repeat_size_ > 0.0; }
  const char* name() const override { return kind_ == dop853 ? "DOP853" : "RK45"; }
  int error_order() const override { return kind_ == dop853 ? 7 : 4; }
  // Size of the next step that `make_step` will try.
  double next_step_size(double t_bound) const;
  // Step size of RK45, estimated from the error of the last step.
  double order_five_step_size() const;

 private:
  friend class Lanes;
  // A step whose stages were computed with those of others (Lanes), if h > 0.
  struct Computed {
    double t = 0.0, h = 0.0;
    double squares[2];    // of its error estimates, relative to the tolerance
    const double* rates;  // at the stages, one number each `stride`; overwritten when Lanes computes the next steps
    Eigen::Index stride;
  };
  bool stages(double h);
  bool take_computed_stages();
  void read_computed_rates();
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
  Computed computed_;
  bool rates_are_computed_ = false;  // whether the rates at the stages are those of computed_, and not in K_
  bool has_dense_output_ = false;
  double repeat_size_ = 0.0;  // s, size with which the rejected step is repeated; 0 if the last step was not rejected
  // Whether the last accepted step, and the new one, ask for a growth of more than max_single_growth.
  bool growth_pending_ = false, growth_next_ = false;
  double order_five_size_ = 0.0, order_five_error_ = 1.0;  // of the last step: its size, reduced for safety, and error
};

}  // namespace ckc
