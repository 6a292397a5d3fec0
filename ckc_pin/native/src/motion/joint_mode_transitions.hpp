// Which joints slide, stick and touch from an instant on, and what an impact there does: two convex problems in the
// metric of D', over velocities and over accelerations.
#pragma once

#include <optional>

#include "motion/events.hpp"

namespace ckc {

class JointChanges {
 public:
  // `rise`: rad, or of the mechanism's size: a bounce that would rise no further is none.
  JointChanges(System& system, double rise, const Tolerance& tolerance);

  void begin();  // a motion begins
  // Decide, at the core's exact state, that of y, from what was met there; `within`: s, how closely events are located.
  // A velocity that jumps is changed in y. False where that cannot be: the system's trouble says why, or none does.
  bool decide(double t, Out y, const std::vector<Event>& met, double within);
  Vector coordinates;   // (n), of the state that was decided about
  double flight = 0.0;  // s: how long the first bounce from there will last, infinite where there is none

 private:
  bool take_state(double t, Out y);  // and close it in y
  // What comes to a stop, or to rest, where that was met.
  std::vector<System::Met> arriving(const std::vector<Event>& met) const;
  bool impact(double t, Out y, std::optional<double>& energy);  // the kinetic energy before it, J; none without an impact
  bool grip(double t, Out y, const Indices& before);  // `before`: what stuck or touched when this instant began
  // Leave in `at`, and in the columns of responses_, the coordinates that the loops let move; false where J has lost rank.
  bool movable(Indices& at);
  void scale(const Indices& at);  // A_, free of units: what unit forces make of the coordinates that they are on
  bool rests(int k) const { return std::abs(v_(k)) <= rest_(k); }
  bool is_into(int k) const { return near_[k] * v_(k) > 0.0 && !rests(k); }  // its stop
  bool hits(int k) const;  // has just been thrown back by its stop, with a speed that follows from a restitution
  void note(double t, int k, JointChange::What what, int direction) {
    joints_.changes.push_back({t, k, what, direction});
  }

  System& system_;
  Core& core_;
  Joints& joints_;
  const double rise_;
  const Tolerance& tolerance_;
  bool known_ = false;  // whether a decision was made since the begin
  Vector v_, a_, held_, rest_, step_;
  Indices near_;        // (n): the stop that a joint is at, as `touch`
  std::vector<System::Met> arrived_;  // what is as it is now because it has come there now
  bool slips_ = false;  // what holds has given way
  Matrix responses_, A_;
  Vector b_, low_, high_, scale_, x_, rounding_;
};

}  // namespace ckc
