// Quantities that are integrated along with a motion and do not influence it, such as its sensitivities.
#pragma once

#include <utility>

#include "tree/types.hpp"

namespace ckc {

// A coordinate arrives at a stop, or its rate at zero, so that joint modes change.
struct JointArrival {
  int coordinate;
  bool of_rate;
  int stop = 0;  // side of the stop, -1 for the lower one; 0: none
};

// The last entries of y. They form columns of equal size, and the Jacobian of each column's rate with respect to the
// column is the same. The step loop owns the integrand, and the formulation (motion/system.hpp) appends its rates.
// Arguments `y` and `y_dot` have all entries.
class Integrand {
 public:
  virtual ~Integrand() = default;

  virtual int size() const = 0;  // number of entries
  // Set the entries of y at the start of a motion from a configuration with velocity v'.
  virtual void start(In q_tree, In v_tree, Out y) = 0;
  // Compute their rates at the state of the last right-hand side, whose motion has the rates in y_dot. False, with a
  // reason in `System::failure`, if there are none.
  virtual bool rates(In y, Out y_dot) = 0;
  // Compute the Jacobian of each column with respect to itself, at the state of the last `System::jacobian`. False if
  // there is none.
  virtual bool jacobian(In y, Matrix& of_column) = 0;
  // Pairs (i, j) of entries of a column where the rate of entry i is entry j.
  virtual void rate_pairs(std::vector<std::pair<int, int>>& of) const = 0;
  virtual void accept_step(In y) = 0;

  // Called at a transition of joint modes, where the core is at y: before it, with the arrivals; in each round of an
  // impact, which adds `step` to the velocities by impulses `x` on the coordinates `at`; and after it. False if the
  // motion is not differentiable there.
  virtual bool before_transition(double t, In y, const std::vector<JointArrival>& arrivals) = 0;
  virtual bool at_impact(In step, const Indices& at, const Matrix& responses, In x, double restitution) = 0;
  virtual bool after_transition(double t, Out y, const std::vector<JointArrival>& arrivals, double rtol,
                                double atol) = 0;
  // At the end of an accepted step: whether locked joints stay locked for neighbouring parameter values.
  virtual bool stays_locked(double atol) = 0;
  // After a sample, where the core is at y, or after a delayed output was applied. `changed`: whether integration has
  // to restart. False, with a reason in `System::failure`, if a derivative is unknown.
  virtual bool control_sampled(In y, bool& changed) = 0;

  virtual int record_size() const = 0;  // columns in a row of the record
  // Fill them; the core is at y, and its control has been evaluated.
  virtual void fill_record(In y, Out row) = 0;
};

}  // namespace ckc
