// Dry friction and joint stops: the mode of each joint (sliding, sticking, at a stop), its forces, and how long it
// lasts.
//
// A sliding joint is opposed by its full friction, a constant. A joint that sticks or touches a stop is a constraint
// row with a bounded multiplier: friction acts both ways, a stop one way only. The bounds do not depend on other
// forces, so the choice of modes is a convex problem (Gauss' principle). It is solved at the instants where a mode
// changes.
#pragma once

#include <algorithm>
#include <vector>

#include <Eigen/Eigenvalues>

#include "tree/types.hpp"

namespace ckc {

// Eigenvalue of the scaled A, relative to the largest, below which rows are linearly dependent.
constexpr double dependent_row_tolerance = 1e-10;

struct JointTable {
  Vector friction;      // (n), N m or N
  Vector lower, upper;  // (n): stops, infinite where there are none
  Vector restitution;   // (n)
  Vector reach;         // (n): unit of each coordinate, one radian or the mechanism's size
  double size = 1.0;    // size of the mechanism, m
  // Velocity scale of the tanh of smooth friction, rad/s or m/s. Zero: friction with stick-slip events.
  double smoothing = 0.0;
};

struct JointTransition {
  double t;
  int coordinate;
  enum Kind { sticks, slides, touches, leaves, bounces } kind;
  int direction;  // of the motion, or of the stop: -1 for the lower one
};

class Joints {
 public:
  Joints(JointTable table, int n);

  const JointTable table;
  const bool has_friction_events, has_stops;  // whether any joint has them; smooth friction has no events
  bool has_events() const { return has_friction_events || has_stops; }
  bool has_friction_at(int k) const { return has_friction_events && table.friction(k) != 0.0; }
  // Whether joints exert forces on the tree.
  bool exerts_force() const { return has_friction_events || smooth_friction_; }
  bool has_smooth_friction() const { return smooth_friction_; }

  // --- modes ---
  Indices sliding_direction;  // (n): direction of sliding of a joint with friction, zero if it does not slide
  Indices stop_side;          // (n): -1 at the lower stop, 1 at the upper, zero otherwise
  Indices locked;             // coordinates that stick or are at a stop
  bool is_locked(int k) const { return std::find(locked.begin(), locked.end(), k) != locked.end(); }
  Indices immobile;  // coordinates with friction that the loops block
  Vector locked_at;  // (n): positions of the locked coordinates
  // Add the friction of sliding joints at velocity v.
  void add_friction_force(In v, Out force) const;
  double lower_force(int k) const { return stop_side[k] > 0 ? -infinite : -table.friction(k); }
  double upper_force(int k) const { return stop_side[k] < 0 ? infinite : table.friction(k); }
  // Return the first coordinate that is beyond its stop by more than `tolerance` (rad, or relative to the mechanism's
  // size), or -1. Locked joints are skipped: they drift within the integration tolerance. `at`: indices of the
  // coordinates in q'.
  int find_joint_beyond_stop(In q_tree, const Indices& at, double tolerance) const;
  double stop_at(int k, int side) const { return side < 0 ? table.lower(k) : table.upper(k); }

  void reset();
  void account_friction_work(In coordinates);  // add the friction work since the last call; call before a mode changes
  void lock(Indices which, In coordinates);    // lock these joints; `stop_side` tells which are at a stop

  // --- holding forces of locked joints ---
  //
  // Add the acceleration that the holding forces cause to `a`, so that locked joints do not accelerate. `responses`:
  // acceleration per unit force on each locked coordinate, (n, locked).
  void add_holding_acceleration(const Matrix& responses, Out a);
  const Vector& holding_forces() const { return holding_forces_; }  // by locked coordinate, from the last call
  // Add d force / d v of smooth friction, (n).
  void add_friction_derivative(In v, Out slopes) const;
  // Distance of the last holding forces from their bounds; negative if no forces within the bounds hold the joints.
  // `rounding`: error of the acceleration of each locked coordinate.
  double holding_margin(In rounding);
  // Return the locked joints (indices in `locked`) whose force is at its bound within rounding.
  Indices find_joints_at_force_limit(In rounding) const;
  double rate_rounding = 0.0;    // 1/s: rounding of rates, relative to `reach`, at the last mode transition
  double rounding_factor = 1.0;  // multiplies rounding errors; grows when modes change repeatedly at one instant
  // Compute the change of a velocity or small displacement x that makes its locked coordinates zero.
  void compute_correction(const Matrix& responses, In x, Out step);
  // By locked coordinate, from the last correction.
  const Vector& correction_forces() const { return correction_forces_; }

  // --- history ---
  std::vector<JointTransition> transitions;
  double impact_loss = 0.0;                        // J
  double dissipated_energy(In coordinates) const;  // by friction and impacts since the start, J

 private:
  static constexpr double infinite = std::numeric_limits<double>::infinity();
  void factorize_locked_rows(const Matrix& responses);
  void minimum_norm_forces(const Matrix& responses, In x, Vector& force);
  Matrix inverse_root() const;  // (rank, m): R with R^T R the pseudoinverse of A_
  Vector force_rounding(const Matrix& inverse_root, In rounding) const;  // rounding of the scaled forces
  const bool smooth_friction_;
  double friction_work_ = 0.0;
  Vector accounted_at_;  // (n): coordinates at the last accounting
  // A_: responses of the locked coordinates to unit forces on them, scaled to a unit diagonal by scale_; its rank.
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;
  Eigen::Index rank_ = 0;
  Matrix A_;
  Vector scale_, holding_forces_, target_acceleration_, correction_forces_;
};

}  // namespace ckc
