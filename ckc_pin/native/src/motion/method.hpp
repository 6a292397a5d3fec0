// Interface of the integration methods, and the step that they make.
#pragma once

#include "motion/system.hpp"

namespace ckc {

struct Tolerance {
  double rtol, atol, max_step;
  double newton = 0.2;  // tolerance of an implicit method's iteration, relative to the local error

  // Error tolerance by component in a step from a to b; an expression that is evaluated where it is assigned.
  auto scale(const Vector& a, const Vector& b) const {
    return (rtol * a.cwiseAbs().cwiseMax(b.cwiseAbs()).array() + atol).matrix();
  }
};

// A step from (t, y) to (t_new, y_new).
struct Step {
  double t = 0, h = 0;           // h: step size to try
  Vector y, f;                   // f: rate of y
  Vector x, x_dot;               // full motion and its rate, see System::full_motion
  double t_new = 0, h_next = 0;  // h_next: size of the next step
  Vector y_new, f_new, x_new, x_dot_new;
  double t_old = 0;  // start of the previous step
  Vector y_old;
};

// Counters of the work done, and its budget.
struct Work {
  long rhs = 0, rejected = 0, jacobians = 0, factorizations = 0;
  long max_rhs = std::numeric_limits<long>::max();
  bool budget_exhausted = false;
  // Count one right-hand side. False if the budget is exhausted.
  bool count_rhs() {
    budget_exhausted = rhs >= max_rhs;
    if (!budget_exhausted) ++rhs;
    return !budget_exhausted;
  }
};

// Interpolates y within the last step.
class Interpolant {
 public:
  virtual ~Interpolant() = default;
  virtual bool interpolate(double t, Out y) = 0;  // false if a right-hand side does not exist
};

class Method : public Interpolant {
 public:
  Method(System& system, Step& step, Work& work, const Tolerance& tolerance)
      : system_(system), step_(step), work_(work), tolerance_(tolerance) {}
  // Try a step from (t, y, f). False if its error is too large and the next call is to repeat it (`is_repeating`), or
  // if no step can be made; the state is then unchanged. An implicit method repeats steps itself.
  virtual bool make_step(double t_bound) = 0;
  virtual bool is_repeating() const { return false; }
  // Discard the last step and try another step size next.
  virtual void reject_step(double step_size) { step_.h = step_size, ++work_.rejected; }
  // Make the end of the last step the present state.
  virtual void accept_step() {
    step_.t_old = step_.t, step_.y_old = step_.y;
    step_.t = step_.t_new, step_.y = step_.y_new, step_.f = step_.f_new, step_.h = step_.h_next;
    step_.x.swap(step_.x_new), step_.x_dot.swap(step_.x_dot_new);
  }
  // Forget previous steps.
  virtual void reset_history() {}
  virtual const char* name() const = 0;
  // Initial step size for a method with an error estimate of this order; requires f.
  double initial_step_size(double t_bound, int order);
  virtual int error_order() const = 0;

  // Evaluate the rate and the full motion at the start of the next step. If Lanes has computed the rate, take that.
  bool evaluate_start();

  bool evaluate(double t, In y, Out y_dot) { return work_.count_rhs() && system_.rhs(t, y, y_dot); }

 protected:
  // Whether a right-hand side that Lanes has computed is in the budget. It is counted as if it had been evaluated here.
  bool count_computed_rhs() { return work_.count_rhs() && (system_.counts.factorizations += 2, true); }
  // Whether to give up, because shorter steps would not help.
  bool must_stop() const { return work_.budget_exhausted || system_.control.failure.raised; }
  // Smallest step size that changes t.
  double min_step_size(double t_bound) const;
  // Whether to check the full motion in a step of size h. If y is only a part of the motion, the full motion has to
  // agree with the integral of its rates. Near a singular phi_z or on another branch it does not, however small the
  // error of y.
  bool checks_full_motion(double h) const { return step_.x.size() && h <= system_.full_motion_max_step(); }
  double disagreement(In integral);  // of the full motion with this integral of its rates, relative to the tolerance
  // After a step was rejected for a disagreement: project its start again, more exactly.
  bool return_to_start();

  // Root mean square of x / scale; zero without entries.
  double norm(In x, const Vector& scale) const {
    if (!x.size()) return 0.0;
    return std::sqrt((x.array() / scale.array()).square().sum() / static_cast<double>(x.size()));
  }

  System& system_;
  Step& step_;
  Work& work_;
  const Tolerance& tolerance_;
  bool start_is_computed_ = false;  // whether Lanes has computed step_.f
  Vector x_scale_, x_error_;
};

}  // namespace ckc
