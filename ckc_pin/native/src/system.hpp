// A formulation as a first-order system y' = f(t, y), as the step loop needs it: `simulation.systems`.
#pragma once

#include "drive.hpp"

namespace ckc {

struct Counts {
  long newton = 0, factorizations = 0;
};

class System {
 public:
  System(Core& core, int size);
  virtual ~System() = default;

  // False where it does not exist or is not finite.
  virtual bool rhs(double t, In y, Out y_dot) = 0;
  // The core at the state, closed as well as the formulation closes it, with everything below; false where it fails.
  virtual bool exact(double t, In y) = 0;
  // The same for a state that `rhs` was evaluated at last, as closed as it is.
  virtual bool at_last(double t, In y) = 0;
  // The core with J where a state is, whatever its velocity; false where that is not known from the state alone.
  virtual bool place(In) { return false; }
  // What becomes of an accepted state: `changed` says whether y is another one now.
  virtual bool accept(double t, Out y, bool& changed) = 0;
  // d rhs / d y; false where it is not known, or not finite.
  virtual bool jacobian(double, In, Matrix&) { return false; }
  // Rate of phi over phi on a level set: what phi_dot should be.
  virtual double decay() const { return 0.0; }

  Core& core;
  const int size;         // of y
  Drive drive;
  Counts counts;
  bool needs_chart = true;  // q has to determine z
  bool crosses = false;     // Python passes positions where J loses rank
  Vector velocity;          // of the tree, (n)
  Vector v_tree;            // what C takes its velocity from, (n)
  Vector w;                 // what phi should be, (rows)
  Vector q, q_dot;          // (d)
};

}  // namespace ckc
