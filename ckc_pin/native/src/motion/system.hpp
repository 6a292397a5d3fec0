// A formulation as a first-order system y' = f(t, y), as the step loop needs it.
#pragma once

#include "control/control.hpp"
#include "loops/elimination_check.hpp"
#include "loops/spectrum.hpp"

namespace ckc {

// Of |J|: phi_z's least singular value at which q has stopped to be a chart.
constexpr double chart_margin = 1e-5;

struct Counts {
  long newton = 0, factorizations = 0, switches = 0;
  long differences = 0;  // Jacobians that were not exact
  long pivoted = 0;      // right-hand sides for which the compiled elimination was not good enough
};

// Why a right-hand side does not exist.
enum class Trouble {
  none,
  open,      // the loops could not be closed
  rank,      // J has lost rank
  infinite,  // a number is not finite
  control,   // a controller has no u
  vague,     // z is not known to the tolerance
  shares,    // how motors at their limits share what they do not reach has no known derivative
  pole,      // a motor goes from its limit to the other one at once: what is wanted of it passes through infinity
};

// What becomes of an accepted state.
enum class Accepted {
  kept,
  changed,    // y is another one now, on the same motion
  restarted,  // y is in other coordinates: nothing that is remembered of former steps holds
  refused,    // the coordinates end here
};

class System {
 public:
  System(Core& core, Control& control, int size);
  virtual ~System() = default;

  // Begin at t from a configuration closed on phi = w, moving with v' (at rho q_dot, off the manifold too).
  virtual void start(double t, In q_tree, In v_tree, In w, Out y) = 0;
  // False where it does not exist or is not finite.
  virtual bool rhs(double t, In y, Out y_dot) = 0;
  // Of the motion alone, of its part of y.
  virtual bool moves(double t, In y, Out y_dot) { return rhs(t, y, y_dot); }
  // The core at the state, closed as well as the formulation closes it, with everything below; false where it fails.
  virtual bool exact(double t, In y) = 0;
  // The same, but with the loops as open as y has them, where they can be.
  virtual bool as_is(double t, In y) { return exact(t, y); }
  // What y itself has of a coordinate, or of its rate, but for how open the loops are; false where it has it not.
  virtual bool shows(In, int, bool, double&) const { return false; }
  // Write the core's state, which is exactly y's, into y: closed.
  virtual void put_exact(Out) const {}
  // `exact` where a motion goes on from.
  virtual bool at_start(double t, In y) { return exact(t, y); }
  // And for a state that `rhs` was evaluated at last, as closed as it is.
  virtual bool at_last(double t, In y) = 0;
  // The core with J where a state is, whatever its velocity; false where that is not known from the state alone.
  virtual bool place(In) { return false; }
  // How far q is from failing as coordinates, at the core's state: phi_z's least singular value over |J|, both free of
  // units; infinite where no q is needed.
  virtual double margin() { return std::numeric_limits<double>::infinity(); }
  double phi_z_margin();
  virtual Accepted accept(double t, Out y, double margin) = 0;
  // Make the user's own partition that of q; false where phi_z is singular there.
  virtual bool own_partition(double, Out, bool& changed) { return changed = false, true; }
  // d rhs / d y of the motion, here by differences, counted in `evaluations`; false where one does not exist.
  virtual bool jacobian(double t, In y, Matrix& jacobian, long& evaluations);
  // Its entries of y whose rate is another entry: (where, which).
  virtual void rates(std::vector<std::pair<int, int>>& of) const = 0;
  // And by itself of each column that y has beside the motion, where `jacobian` was asked for last; null where it has none.
  virtual const Matrix* beside_jacobian() const { return nullptr; }
  virtual void beside_rates(std::vector<std::pair<int, int>>&) const {}
  // Time in which the motion may change, known from the start, s: that of a boundary layer.
  virtual double layer() const { return std::numeric_limits<double>::infinity(); }
  // Whether the motion keeps its energy where nothing acts and nothing dampens.
  virtual bool conserves() const { return false; }
  // Rate of phi over phi on a level set: what phi_dot should be.
  virtual double decay() const { return 0.0; }
  // The part of a Jacobian at y whose eigenvalues tell how the freedoms move; false where there is none.
  virtual bool modes(In, Matrix&) { return true; }
  // Acceleration of the tree at the state that `rhs` was evaluated at last; false where it is not known.
  virtual bool tree_acceleration(In f, Out a) const = 0;
  // A step was refused because y does not tell the rest of the motion as its rates do: forget what was found since the
  // last accepted state, and be more exact from there; false where that has not helped.
  virtual bool return_to_accepted() { return true; }
  // How many numbers the whole motion (q', v') is where y is only a part that determines it, else zero.
  virtual int whole_size() const { return 0; }
  // How many numbers of y, its last ones, are no part of the motion.
  virtual int beside() const { return 0; }
  // The longest step over which its rates add up to anything, s.
  virtual double whole_within() const { return std::numeric_limits<double>::infinity(); }
  // The whole motion and its rate at the state that `rhs` was evaluated at last, f = rhs(t, y).
  virtual void whole(In, Out, Out) const {}
  // Add to what may be wrong in each of its numbers x what rounding alone makes wrong.
  virtual void add_rounding(In, Out) const {}

  // --- dry friction and stops ---
  // What acts on the tree where its motion is v: the controller's forces, and friction of what slides.
  const Vector& acting(In v);
  // Acceleration of the tree at the core's state, which is exact, with what holds the joints that stick or touch.
  bool acceleration(double t, Out a);
  // Take back what locked joints have drifted by more than `tolerance`, and their rates, at the core's state, that of y;
  // false where that cannot be.
  bool keep_locked(Out y, double tolerance, bool& changed);
  // --- parameters (sensitivity/sensitivity_system.hpp) ---
  // Of a coordinate, or of its rate: it comes to what it is; to a stop, -1 for the lower one, that moves with parameters.
  struct Met { int coordinate; bool of_rate; int stop = 0; };
  // Where joints change what they do, at y where the core is: what comes there at a time of its own; a round of an
  // impact, that adds `step` to the velocities by impulses `x` on the coordinates `at`, with a restitution; and what has
  // come to be as it is at that time, to a tolerance. False where that time is not one for all of them.
  virtual bool before_change(double, In, const std::vector<Met>&) { return true; }
  virtual bool at_impact(In, const Indices&, const Matrix&, In, double) { return true; }
  virtual bool after_change(double, Out, const std::vector<Met>&, double, double) { return true; }
  // At the end of an accepted step with locked joints: whether they stay locked with parameters on both sides of theirs.
  virtual bool stays_locked(double) { return true; }
  // A controller has looked at y, where the core is, or what it found has come to act; false where that is not known.
  // Whether from here on rates of y are others.
  virtual bool sampled(In, bool&) { return true; }
  // Numbers that are recorded behind those of the state.
  virtual int extra() const { return 0; }
  virtual void put_extra(In, Out) {}  // at the core's state, that of y, with what acts there

  // Add to the velocities, and to the coordinates, in y.
  virtual void push(Out y, In v) const = 0;
  virtual void shift(Out y, In step) const = 0;
  // The motion goes on from y, where the core is, with another velocity: what is remembered of former states is no more.
  virtual void go_on(double, Out) {}

  Core& core;
  Control& control;
  int size;               // of y
  Counts counts;
  EliminationCheck elimination;
  bool crosses = false;     // positions where J loses rank are passed
  bool may_switch = false;  // q may become other coordinates
  Vector velocity;          // of the tree, (n)
  Vector v_tree;            // what C takes its velocity from, (n)
  Vector w;                 // what phi should be, (rows)
  Vector q, q_dot;          // (d)

  Trouble trouble = Trouble::none;  // of the last right-hand side that did not exist

  // Everything that acts at the core's state; false where a controller has no u.
  bool act(double t) { return control.act(measured(t)) || fails(Trouble::control); }
  Measured measured(double t) { return {t, core, q, q_dot, v_tree, q_dot}; }

 protected:
  bool fails(Trouble why) { return trouble = why, false; }
  void new_partition() { phi_z_.reset(); }  // of the core
  // Eq. 1 at the core's state moving with v, what acts there known, with what holds joints; `correction`: of J a.
  bool eq_1(In v, In correction, Out a);
  // d a / d q' and d v' of eq. 1 with that correction, tangent, where what acts at (q', v') is known; the core is there
  // unless its terms are written out and no joint is held. False where what acts has no known derivatives.
  bool slopes(In q_tree, In v, In correction, Matrix& by_q, Matrix& by_v);

  Vector uncorrected_;  // zero, (rows)
  Matrix by_q_, by_v_;  // eq. 1's, where `jacobian` was asked for last and found without differences

 private:
  std::unique_ptr<Spectrum> phi_z_;
  Vector moved_, rate_, rate_here_, acting_, drift_, back_, force_;
  Matrix u_by_q_, u_by_v_, none_;

 protected:
  Vector a_;
  Matrix responses_;
};

}  // namespace ckc
