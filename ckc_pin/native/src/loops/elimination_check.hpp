// Chooses the elimination by which a run computes the acceleration of eq. 1, from its rounding errors at the start
// and along the motion.
//
// Elimination does not pivot, and compiled terms have an order for the masses in the mechanism's files. With very
// different masses its rounding errors can be a million times those of projection on the tangent space: if a light body
// carries a heavy load, the acceleration that the load alone would cause cancels. Step size control then sees noise.
#pragma once

#include "tree/types.hpp"

namespace ckc {

class Core;

class EliminationCheck {
 public:
  // Forget the previous run. The first state of the next run is checked.
  void reset(Core& core);
  // Check the start of a motion. The core is there and moves with v.
  void check_start(Core& core, In v);
  // Whether the next accepted state will be checked. If so, call `remember_state` at the end of each step.
  bool is_due() const { return is_active_ && steps_until_check_ == 0; }
  void remember_state(In q_tree, In v, In u_tree) { q_tree_ = q_tree, v_ = v, u_tree_ = u_tree, is_remembered_ = true; }
  // Call after a step is accepted. If a check is due, the core is left at the remembered configuration.
  void accept_step(Core& core);
  // Do not use elimination for the rest of the run. False if there is none or it is already disabled.
  bool disable_elimination(Core& core);

 private:
  void check(Core& core);

  bool is_active_ = false;          // whether there are two methods to compare
  bool has_uneven_masses_ = false;  // so that projection has to be checked too
  bool has_started_ = false;
  bool is_remembered_ = false;  // whether q_tree_, v_ and u_tree_ are a state to check
  int steps_until_check_ = 0;   // accepted steps until the next check
  int next_interval_ = 0;       // accepted steps from that check to the following one
  Vector q_tree_, v_, u_tree_;
};

}  // namespace ckc
