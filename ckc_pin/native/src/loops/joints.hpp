// Dry friction and stops: which joints slide, stick and touch, what that does to the motion, and until when it holds.
//
// A joint that slides is opposed by the whole of its friction, a constant. One that sticks or touches is a row added to
// the closure, whose multiplier has bounds: friction's both ways, a stop's one way only. Bounds that do not depend on
// other forces make the choice of who slides, sticks and touches a convex problem (Gauss' principle), solved at
// the instants where something changes.
#pragma once

#include <algorithm>
#include <vector>

#include <Eigen/Eigenvalues>

#include "tree/types.hpp"

namespace ckc {

constexpr double dependent = 1e-10;  // eigenvalue of the rows' scaled A, of its largest, from which rows are idle

struct JointTable {
  Vector friction, lower, upper, restitution;  // (n); infinite where there is no stop
  Vector reach;                                // (n): what a coordinate is measured in, one radian or the mechanism's size
  double size = 1.0;                           // the mechanism's, m
  double smoothing = 0.0;                      // rate at which friction that is no event has grown to tanh 1, zero: none
};

struct JointChange {
  double t;
  int coordinate;
  enum What { sticks, slides, touches, leaves, bounces } what;
  int direction;  // of the motion, or of the stop: -1 the lower one
};

class Joints {
 public:
  Joints(JointTable table, int n);

  const JointTable table;
  const bool rubs, stops;  // any of them, as events
  bool any() const { return rubs || stops; }
  bool rubs_at(int k) const { return rubs && table.friction(k) != 0.0; }
  // Whether a force acts that is no controller's.
  bool acts() const { return rubs || smooth_; }
  bool smooth() const { return smooth_; }

  // --- what they do ---
  Indices sign;    // (n): which way a joint with friction slides, zero where it does not
  Indices touch;   // (n): -1 at the lower stop, 1 at the upper, zero at none
  Indices locked;  // coordinates that stick or touch
  bool is_locked(int k) const { return std::find(locked.begin(), locked.end(), k) != locked.end(); }
  Indices idle;    // with friction, but the loops leave them no way to move from where they are
  Vector place;    // (n): where those are
  // Of sliding, the others' motion being v.
  void add_friction(In v, Out force) const;
  double lower_force(int k) const { return touch[k] > 0 ? -infinite : -table.friction(k); }
  double upper_force(int k) const { return touch[k] < 0 ? infinite : table.friction(k); }
  // The first joint that is further beyond its stop than `tolerance`, in radians or of the mechanism's size, or -1. Joints
  // that are held are not: they drift within the integration's tolerance between the ends of a step. `at`: where
  // coordinates stand in q'.
  int beyond_stop(In q_tree, const Indices& at, double tolerance) const;
  double stop_at(int k, int side) const { return side < 0 ? table.lower(k) : table.upper(k); }

  void begin();
  void account(In coordinates);  // for what was rubbed off since it was done last, before something changes there
  void lock(Indices which, In coordinates);  // those at rest stick, or touch as `touch` says

  // --- forces that hold them ---
  // `a`: acceleration without them; `responses`: what one unit of each makes, (n, locked). Add what they make to `a`.
  void hold(const Matrix& responses, Out a);
  const Vector& forces() const { return force_; }  // by locked coordinate, those that were found last
  // d force / d v of friction that is no event, (n).
  void add_slopes(In v, Out slopes) const;
  // How far the forces that `hold` found last are from not being enough: negative where none within their bounds are.
  // `rounding`: by locked coordinate, how wrong its acceleration may be.
  double margin(In rounding);
  // Which locked coordinates, by number in `locked`, only rounding keeps from being let go: their force is at its limit.
  Indices at_limit(In rounding) const;
  double rate_rounding = 0.0;  // 1/s: what rounding made of rates, by reach, at the last change of modes
  double patience = 1.0;  // times the rounding error: more where joints change their mode again and again at an instant
  // What is to be added to a velocity, or a small displacement, so that x of the locked coordinates vanishes.
  void back(const Matrix& responses, In x, Out step);
  const Vector& back_forces() const { return back_; }  // by locked coordinate, that `back` has added last

  // --- what they have done ---
  std::vector<JointChange> changes;
  double impact_loss = 0.0;  // J
  double dissipated(In coordinates) const;  // by friction and impacts since the begin, J

 private:
  static constexpr double infinite = std::numeric_limits<double>::infinity();
  void factor(const Matrix& responses);
  void least_forces(const Matrix& responses, In x, Vector& force);
  Matrix inverse_root() const;  // (rank, m), R with R^T R the pseudoinverse of A
  Vector force_rounding(const Matrix& inverse_root, In rounding) const;  // of forces, each as A measures it
  const bool smooth_;
  double rubbed_ = 0.0;
  Vector since_;  // (n): the coordinates where they were set
  // The scaled matrix A = G D^-1 G^T of the locked rows, its rank, and the minimum-norm forces that hold.
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;
  Eigen::Index rank_ = 0;
  Matrix A_;
  Vector scale_, force_, wanted_, back_;
};

}  // namespace ckc
