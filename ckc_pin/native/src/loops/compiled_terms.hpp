// A mechanism's terms written out as C for it alone: the library that `ckc_pin.generated` compiled and checked.
#pragma once

#include <string>
#include <vector>

#include "tree/trig.hpp"

namespace ckc {

class Written {
 public:
  // The library at `path`, and the numbers of the mechanism that its code takes.
  Written(const std::string& path, In parameters);
  ~Written();
  Written(const Written&) = delete;

  void vary(In parameters);  // other numbers
  long long parameters() const { return taken_; }

  void place(In q, Out phi, Matrix& J) const;
  void inertia(In q, Matrix& D_tree) const;
  void bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const;
  void jacobian_rate(In q, In v, Matrix& J_dot) const;
  void rest(In q, Out h_tree) const;  // h' less what springs do
  // C' x; only of trees whose joints have one freedom each: of a free root's twist there are several C'.
  void coriolis(In q, In v, In x, Out product) const;
  bool has_coriolis() const { return coriolis_; }
  double potential_energy(In q) const;
  // Whether what is eliminated below may be used: in the numbers in use it may round too much (loops/elimination_check.hpp). Where it
  // may not, all of it says false; `eliminate` is the acceleration all the same.
  void allow_elimination(bool allowed) { eliminates_ = allowed; }
  bool eliminates() const { return eliminates_; }
  // Eq. 1 by elimination without pivoting; false where it would have to pivot.
  bool acceleration(In q, In v, In u_tree, In correction, Out acceleration) const {
    return eliminates_ && eliminate(q, v, u_tree, correction, acceleration);
  }
  bool eliminate(In q, In v, In u_tree, In correction, Out acceleration) const;
  // How that changes: at a state, and then along a direction, a step of q', a change of v', and `more`: of u', and of
  // J v'_dot by the rows that are kept; or along as many at a time as there are lanes, a row each, where there are more
  // than one. Only of a library made for it. False as above, and no changes there are known.
  bool has_changes() const { return state_; }
  int lanes() const { return lanes_; }
  int directions() const { return directions_; }  // how many numbers one is
  bool state(In q, In v, In u_tree) const;
  void change(In direction, Out acceleration) const;
  void changes(const Matrix& directions, Matrix& acceleration) const;  // (lanes, ...), (lanes, n)
  // The groups of parameters that a change of them is of, and what such a group adds to `more`.
  Indices groups(In varied) const;
  void varied(int group, In varied, Out more) const;
  // The x with J x = -residual that is smallest in the metric of D'; false as above.
  bool closing_step(In q, In residual, Out x) const;
  // d (q'_dot, v'_dot) / d (q', v') and d v'_dot / d u'; false as above, or where that was too long to be written.
  bool jacobian(In q, In v, In u_tree, Matrix& by_state, Matrix& by_u) const;

 private:
  using Code = int (*)(const double**, double**, long long*, double*, int);
  void* symbol(const std::string& name) const;
  Code code(const char* name, int arguments) const;     // of so many
  Code perhaps(const char* name, int arguments) const;  // null where there is none
  long long size(const char* of, long long k = 0) const;
  bool find_state(In q, In v, In u_tree) const;  // one that was not asked for last

  // Cosines and sines of q, which most functions of one state share.
  const double* trig(In q) const { return trig_.of(q); }

  void* library_;
  long long taken_ = 0;  // parameters: to look a function up takes longer than to call it
  Vector numbers_;  // the parameters, and what follows from them alone
  mutable Trig trig_;
  struct alignas(64) Line {  // of the processor's cache: what is read four at a time is in one
    double x[8];
  };
  mutable Vector q_, v_, u_, acceleration_at_;  // the last state that changes were asked for,
  mutable std::vector<Line> known_;             // and what is known there
  mutable bool sound_ = false;
  bool eliminates_ = true;
  int lanes_ = 1, directions_ = 0;
  Code given_, place_, inertia_, bias_, jacobian_rate_, rest_, coriolis_, potential_energy_, acceleration_, closing_step_, jacobian_;
  Code state_, change_, changes_, groups_;
  std::vector<Code> varied_;
};

}  // namespace ckc
