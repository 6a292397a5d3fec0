// By which elimination a run takes eq. 1's acceleration: judged by its rounding in the numbers in use, at the start and along
// the motion.
//
// The compiled elimination has no pivoting and an order that was chosen for the masses of the mechanism's files. With masses far
// from these it rounds up to a million times as much as projection on the tangent space does: where a light body carries a
// load, the acceleration that the load alone would give it cancels. Step-size control then sees noise.
#pragma once

#include "tree/types.hpp"

namespace ckc {

class Core;

class EliminationCheck {
 public:
  // Forget what was before: the first state of a run is checked.
  void start(Core& core);
  // Where a motion begins: the core is there, and moves with v.
  void begin(Core& core, In v);
  // Whether the next accepted state will be checked; `remember` is then called where a step ends there.
  bool is_due() const { return active_ && wait_ == 0; }
  void remember(In q_tree, In v, In u_tree) { q_tree_ = q_tree, v_ = v, u_tree_ = u_tree, known_ = true; }
  // A state was accepted. Where the check is due, the core is left at the configuration remembered.
  void accept(Core& core);
  // Take the general core's elimination for the rest of the run; false where that is done already, or nothing is compiled.
  bool give_up(Core& core);

 private:
  void check(Core& core);

  bool active_ = false, uneven_ = false;  // whether there is something to check; whether masses are very unequal
  bool begun_ = false, known_ = false;
  int wait_ = 0, next_wait_ = 0;  // accepted steps until the next check, and from there until the one after it
  Vector q_tree_, v_, u_tree_;
};

}  // namespace ckc
