// What a run keeps at its output instants, a row each.
#pragma once

#include "motion/system.hpp"

namespace ckc {

class Recorder {
 public:
  explicit Recorder(const System& system);

  // t, q', velocity, u, tau, phi, w, energy, energy that friction and impacts took, Lyapunov
  // function, largest |phi - w|, largest |phi_dot - w_dot|, what the system adds
  const int width;

  void begin(Vector instants, double* rows, Eigen::Index most);  // rows: most by width
  bool due(double t) const { return next_ < instants_.size() && instants_(next_) <= t && filled < most_; }
  double instant() const { return instants_(next_); }
  bool full() const { return filled == most_; }
  // Record the state at (t, y), unless that instant is recorded already; false where the state has no terms.
  bool add(System& system, double t, In y);
  void passed() { ++next_; }
  // Remove the last row if it is of time t, so that another state can be recorded there.
  void drop_row_at(double t) { filled -= filled && rows_[(filled - 1) * width] >= t; }

  Eigen::Index filled = 0;

 private:
  bool row(System& system, double t, In y, Out row);

  Vector instants_, momentum_;
  double* rows_ = nullptr;
  Eigen::Index most_ = 0, next_ = 0;
};

}  // namespace ckc
