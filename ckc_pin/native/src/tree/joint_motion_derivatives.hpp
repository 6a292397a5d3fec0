// Points and directions that joints carry, and how they and their rates change along coordinates and with velocities.
#pragma once

#include "tree/tree.hpp"

namespace ckc {

// How the motion of a joint changes along each coordinate of its support, and with each velocity; world axes.
struct Sway {
  Matrix6x place, velocity, rate;    // twists: along a coordinate
  Matrix6x rate_by_v;                // with a velocity; of the velocity that is `place`
};

// After `Tree::derivatives`, overwriting what was found before.
void changes_of(const Tree& tree, int joint, Sway& found);

struct Carried {
  using Columns = Eigen::Matrix<double, 3, Eigen::Dynamic>;

  // A point where `is_point`, else a direction, given in the joint's axes.
  void set(const Tree& tree, int of, const Vector3& local, bool is_point, const Sway& changes);

  int joint = 0;
  Vector3 x, x_dot, x_ddot;
  Columns by_q;         // a column a coordinate of the support; of x_dot by velocities too
  Columns dot_by_q, ddot_by_q, ddot_by_v;
};

}  // namespace ckc
