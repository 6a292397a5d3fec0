// What the step loop needs of a method, and the step that it makes.
#pragma once

#include "motion/system.hpp"

namespace ckc {

struct Tolerance {
  double rtol, atol, max_step;
  double newton = 0.2;  // of an implicit method's iteration, relative to the local error

  // What an error may be in each number of a step from a to b; an expression, evaluated where it is assigned.
  auto between(const Vector& a, const Vector& b) const {
    return (rtol * a.cwiseAbs().cwiseMax(b.cwiseAbs()).array() + atol).matrix();
  }
};

struct Step {
  double t = 0, h = 0;  // from (t, y) with rate f; h: a length to try
  Vector y, f;
  Vector x, x_dot;      // the whole motion there
  double t_new = 0, h_next = 0;  // to (t_new, y_new)
  Vector y_new, f_new, x_new, x_dot_new;
  double t_old = 0;  // where the one before began
  Vector y_old;
};

struct Work {
  long rhs = 0, rejected = 0, jacobians = 0, factorizations = 0;
  long most_rhs = std::numeric_limits<long>::max();
  bool spent = false;  // the budget was met
  // One more right-hand side; false where none may be.
  bool one_more() {
    spent = rhs >= most_rhs;
    if (!spent) ++rhs;
    return !spent;
  }
};

// y within the step just made.
class Interpolant {
 public:
  virtual ~Interpolant() = default;
  virtual bool between(double t, Out y) = 0;  // false where a right-hand side does not exist
};

class Method : public Interpolant {
 public:
  Method(System& system, Step& step, Work& work, const Tolerance& tolerance)
      : system_(system), step_(step), work_(work), tolerance_(tolerance) {}
  // Try steps from (t, y, f) until one is accepted; false where none can be, and then nothing is lost but the work.
  virtual bool step(double t_bound) = 0;
  // Forget the step just made and try one of another length next.
  virtual void retry(double length) { step_.h = length, ++work_.rejected; }
  // Take over the step just made.
  virtual void commit() {
    step_.t_old = step_.t, step_.y_old = step_.y;
    step_.t = step_.t_new, step_.y = step_.y_new, step_.f = step_.f_new, step_.h = step_.h_next;
    step_.x.swap(step_.x_new), step_.x_dot.swap(step_.x_dot_new);
  }
  // Remember nothing of former steps.
  virtual void forget() {}
  virtual const char* name() const = 0;
  // A first length, of a method whose error estimate is of this order; (t, y, f) are known.
  double first_length(double t_bound, int order);
  virtual int error_order() const = 0;

  // The rate where the next step begins, and the whole motion there.
  bool evaluate_start();

  bool evaluate(double t, In y, Out y_dot) {
    return work_.one_more() && system_.rhs(t, y, y_dot);
  }

 protected:
  // Whether a shorter step would be of no use.
  bool over() const { return work_.spent || system_.control.problem.raised; }
  // The shortest step that changes t.
  double shortest(double t_bound) const;
  // Where y is only a part of the motion, the rest has to agree with what its rates add up to: next to where y stops to
  // determine it, or on another branch, it does not, however small the error of y is.
  bool whole(double h) const { return step_.x.size() && h <= system_.whole_within(); }
  double disagreement(In integral);  // of the rates, relative to what is allowed
  // A step was refused for that. Find the state where it begins once more, as closed as it can be.
  bool return_to_start();

  double norm(In x, const Vector& scale) const {
    return std::sqrt((x.array() / scale.array()).square().sum() / static_cast<double>(x.size()));
  }

  System& system_;
  Step& step_;
  Work& work_;
  const Tolerance& tolerance_;
  Vector x_scale_, x_error_;
};

}  // namespace ckc
