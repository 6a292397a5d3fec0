#include "loops/elimination_check.hpp"

#include "loops/core.hpp"
#include "loops/compiled_terms.hpp"

namespace ckc {

// A coordinate, relative to the accelerations that the forces give. Mechanisms whose masses are alike have a tenth of it or less.
constexpr double ordinary = 5e-14;
// Accepted steps between checks, of which each costs about as much as two right-hand sides of the general core.
constexpr int soon = 8, seldom = 128, often = 16;

// Redundant rows contradict each other off the closure, where eliminations that keep different ones differ: put (q', v') on it.
// False where the compiled elimination would need pivots.
static bool put_on_closure(Core& core, Vector& q_tree, Vector& v) {
  constexpr int steps = 3;  // of Newton's method, from a state that the run's tolerance closes
  Vector step(core.n);
  for (int k = 0; k < steps; ++k) {
    core.set(q_tree);
    if (!core.written->closing_step(q_tree, core.rows.phi, step)) return false;
    core.tree.integrate(q_tree, step);
  }
  core.set(q_tree);
  if (!core.written->closing_step(q_tree, core.rows.J * v, step)) return false;
  v += step;
  return true;
}

void EliminationCheck::start(Core& core) {
  if (core.written) core.written->allow_elimination(true);
  uneven_ = core.has_uneven_masses();
  core.use_levels(false);
  active_ = uneven_ || core.written;
  begun_ = known_ = false, wait_ = 0, next_wait_ = soon;
}

void EliminationCheck::begin(Core& core, In v) {
  if (begun_ || !active_) return;
  begun_ = true;
  remember(core.q_tree, v, Vector::Zero(core.n));
  check(core);
}

void EliminationCheck::accept(Core& core) {
  if (!active_) return;
  if (wait_ > 0)
    --wait_;
  else if (known_)
    check(core);
}

bool EliminationCheck::give_up(Core& core) {
  if (!core.written || !active_) return false;
  core.written->allow_elimination(false);
  active_ = false;
  return true;
}

void EliminationCheck::check(Core& core) {
  known_ = false;
  const double limit = ordinary * core.n;
  if (core.q_tree != q_tree_) core.set(q_tree_);
  core.set_velocity(v_);
  if (uneven_ && !core.uses_levels()) core.use_levels(core.rounding_of_projection(u_tree_) > limit);
  bool good = true;
  if (core.written) {
    core.written->allow_elimination(true);
    const bool redundant = core.rank < core.rows.closure.rows;
    Vector q_tree = q_tree_, v = v_;
    if (!redundant || put_on_closure(core, q_tree, v)) {
      core.set_velocity(v);
      good = core.rounding_of_elimination(u_tree_) <= limit;
    }
    if (redundant) core.set(q_tree_), core.set_velocity(v_);
    core.written->allow_elimination(good);
  }
  wait_ = good ? next_wait_ : often;
  next_wait_ = seldom;
}

}  // namespace ckc
