// What the step loop needs of a method, and the explicit one.
#pragma once

#include "system.hpp"

namespace ckc {

struct Tolerance {
  double rtol, atol, max_step;
};

class Method {
 public:
  virtual ~Method() = default;

  // Try steps from (t, y, f) until one is accepted; false where a right-hand side does not exist or steps vanish:
  // nothing is lost then but the work, and Python goes on from (t, y).
  virtual bool step(System& system, double t_bound) = 0;
  // Forget the step just made and try a shorter one next; false where the method cannot.
  virtual bool again(double) { return false; }
  // Make a step that something else integrated, and let the next one try a length; false where the method cannot.
  virtual bool adopt(System&, double, In, double) { return false; }
  // y within the step just made; false where a right-hand side does not exist.
  virtual bool between(System& system, double t, Out y) = 0;
  // Make the step's end the present state, as the system accepts it; false where it does not.
  bool settle(System& system, double t_bound) {
    bool changed = false;
    if (t_new < t_bound) {
      if (!system.accept(t_new, y_new, changed) || (changed && !evaluate(system, t_new, y_new, f_new))) return false;
    }
    commit();
    return true;
  }
  // Take over the step just made.
  virtual void commit() {
    t_old = t, y_old = y;
    t = t_new, y = y_new, f = f_new, h_abs = h_next, growing = growing_next;
  }

  double t = 0, h_abs = 0;  // h_abs: length of the next step to try
  bool growing = false;     // whether the last step asked for one of more than twice its length
  Vector y, f;
  double t_new = 0, h_next = 0;
  bool growing_next = false;
  Vector y_new, f_new;
  double t_old = 0;  // where the last step began
  Vector y_old;
  long rhs = 0, rejected = 0, jacobians = 0, lu = 0;

 protected:
  bool evaluate(System& system, double at, In y_at, Out y_dot) {
    ++rhs;
    return system.rhs(at, y_at, y_dot);
  }
};

// SciPy's DOP853 with SciPy's coefficients and step control, so that its steps are Python's.
class Dop853 : public Method {
 public:
  struct Table {
    Matrix A, A_extra, D;
    Vector B, C, C_extra, E3, E5;
  };

  Dop853(Table table, Tolerance tolerance, int size);
  bool step(System& system, double t_bound) override;
  bool again(double length) override;
  bool adopt(System& system, double to, In y_to, double length) override;
  bool between(System& system, double t, Out y) override;

 private:
  bool stages(System& system, double h);
  double error(double h);

  Table table_;
  Tolerance tolerance_;
  Matrix K_, F_;  // (size, stages), (size, powers)
  Vector y_stage_, scale_, error_;
  bool dense_ = false;
};

}  // namespace ckc
