#include "loops/elimination_check.hpp"

#include "loops/core.hpp"

namespace ckc {

// Accepted rounding error, relative to the accelerations that the forces cause. Mechanisms with similar masses have a
// tenth of it or less.
constexpr double max_rounding_per_coordinate = 5e-14;
// Accepted steps between checks. A check costs about two right-hand sides with Pinocchio's terms.
constexpr int first_interval = 8, regular_interval = 128, retry_interval = 16;

// Project (q', v') onto the constraint manifold. Off the manifold redundant rows contradict each other, so that
// eliminations which use different rows differ. False if elimination would need a pivot.
static bool project_onto_manifold(Core& core, Vector& q_tree, Vector& v) {
  constexpr int newton_steps = 3;  // starting from a state within the run's tolerance
  Vector step(core.n);
  for (int k = 0; k < newton_steps; ++k) {
    core.set_configuration(q_tree);
    if (!core.elimination_step(core.constraints.phi, step)) return false;
    core.tree.integrate(q_tree, step);
  }
  core.set_configuration(q_tree);
  core.compute_J();
  Vector phi_dot(core.constraints.closure.rows);
  core.constraints.multiply_J(v, phi_dot);
  if (!core.elimination_step(phi_dot, step)) return false;
  v += step;
  return true;
}

void EliminationCheck::reset(Core& core) {
  core.allow_elimination(true);
  has_uneven_masses_ = core.has_uneven_masses();
  core.use_mass_levels(false);
  is_active_ = has_uneven_masses_ || core.has_elimination();
  has_started_ = is_remembered_ = false, steps_until_check_ = 0, next_interval_ = first_interval;
}

void EliminationCheck::check_start(Core& core, In v) {
  if (has_started_ || !is_active_) return;
  has_started_ = true;
  remember_state(core.q_tree, v, Vector::Zero(core.n));
  check(core);
}

void EliminationCheck::accept_step(Core& core) {
  if (!is_active_) return;
  if (steps_until_check_ > 0)
    --steps_until_check_;
  else if (is_remembered_)
    check(core);
}

bool EliminationCheck::disable_elimination(Core& core) {
  if (!core.has_elimination() || !is_active_) return false;
  core.allow_elimination(false);
  is_active_ = false;
  return true;
}

void EliminationCheck::check(Core& core) {
  is_remembered_ = false;
  const double limit = max_rounding_per_coordinate * core.n;
  if (core.q_tree != q_tree_) core.set_configuration(q_tree_);
  core.set_velocity(v_);
  if (has_uneven_masses_ && !core.uses_mass_levels())
    core.use_mass_levels(core.rounding_of_projection(u_tree_) > limit);
  bool is_accurate = true;
  if (core.has_elimination()) {
    core.allow_elimination(true);
    const bool redundant = core.rank < core.constraints.closure.rows;
    Vector q_tree = q_tree_, v = v_;
    if (!redundant || project_onto_manifold(core, q_tree, v)) {
      core.set_velocity(v);
      is_accurate = core.rounding_of_elimination(u_tree_, limit) <= limit;
    }
    if (redundant) core.set_configuration(q_tree_), core.set_velocity(v_);
    core.allow_elimination(is_accurate);
  }
  steps_until_check_ = is_accurate ? next_interval_ : retry_interval;
  next_interval_ = regular_interval;
}

}  // namespace ckc
