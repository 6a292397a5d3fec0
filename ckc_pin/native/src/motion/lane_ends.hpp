// Ends of steps for several members of an ensemble at a time (Lanes): what the step loop monitors there, and the
// projection onto the constraint manifold. For mechanisms of one planar loop, without a controller.
//
// Projected states have the digits that `Dae::accept_motion` gives them: the operations are the same, in the same
// order. Singular values and energies, which are only compared with bounds, agree with those of `RankMonitor` and
// `EnergyMonitor` up to rounding.
#pragma once

#include "loops/compiled_terms.hpp"
#include "motion/step_end.hpp"

namespace ckc {

class LaneEnds {
 public:
  using Members = CompiledTerms::Members;
  // Compute the ends of steps at y = (q', v'). `trig`: cosines and sines of q'. `rtol`, `atol`: of the energy.
  void compute(const Core& core, double tolerance, const Members* constants, const Members* y, const Members* trig,
               const Members& rtol, const Members& atol);
  // Copy the end of a member's step. False if the step loop has to compute it.
  bool read(int lane, StepEnd& end) const;

 private:
  using Lines = std::vector<Members>;
  void monitor(const Core& core, const CompiledTerms::MembersAt& at, const Members* v, const Members& rtol,
               const Members& atol);
  void project(const CompiledTerms& terms, CompiledTerms::MembersAt at);
  bool choose_members_to_move();  // for a step of Newton's method; false if there is none

  int n_ = 0;
  Members rank_value_, rank_rate_, energy_, energy_allowance_, closure_tolerance_;
  bool is_projected_[CompiledTerms::members], is_valid_[CompiledTerms::members];
  int newton_steps_[CompiledTerms::members];
  Members is_chosen_, is_sound_;  // of a step; is_chosen_: 1 or 0
  Lines phi_, J_, J_dot_, D_, momentum_, residual_, step_, trig_, y_;
};

}  // namespace ckc
