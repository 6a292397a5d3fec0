// Steps of an explicit method for several members of an ensemble at a time, each member in its own lane of the
// processor's vector registers: the stages, and the ends where `LaneEnds` can. Everything else is each member's own,
// and so is the size of its steps.
//
// A member's results have the same digits as alone: the operations are those of `Explicit` and of the compiled terms,
// in the same order.
#pragma once

#include <array>

#include "loops/compiled_terms.hpp"
#include "motion/explicit.hpp"
#include "motion/lane_ends.hpp"

namespace ckc {

class Lanes {
 public:
  static constexpr int width = CompiledTerms::members;
  // Set the mechanism's numbers of the member in a lane.
  void set_constants(int lane, const Vector& constants);
  using Attempts = std::array<Explicit::Attempt, width>;
  // Compute the stages, error estimates and ends of the next attempts of these members, by lane; without a method where
  // there is no member, or where its next step cannot be computed here. The members take them when they make that step.
  void compute(const Attempts& attempts);
  long end_count = 0;  // ends of steps that were computed, since the construction

 private:
  using Members = CompiledTerms::Members;
  using Lines = std::vector<Members>;
  void compute(const Attempts& attempts, Explicit::Kind kind);
  void start(const Attempts& attempts, const Explicit& first);
  void compute_unknown_starts(const Attempts& attempts);
  void compute_ends(const Attempts& attempts);
  void evaluate(double stage_time, int stage);  // the rate at y_, and which lanes stay valid
  void apply_forces(double stage_time);
  // sum = start + the combination of the first rates, times `factor`
  template <class Coefficients>
  void combine(const Lines& start, const Coefficients& coefficients, int count, const Members& factor, Lines& sum);

  Explicit* methods_[width];  // null: the lane's stages are not valid
  const CompiledTerms* terms_ = nullptr;
  int n_ = 0, size_ = 0;
  bool has_force_ = false;
  double t_[width];
  Members h_, rtol_, atol_;
  Lines start_, zero_, y_, rates_, error_, trig_, force_, correction_, constants_;
  Vector q_tree_, v_, applied_;
  LaneEnds ends_;
};

}  // namespace ckc
