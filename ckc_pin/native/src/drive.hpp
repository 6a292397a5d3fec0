// What acts on the mechanism: nothing, a held force, or one of the paper's controllers, with limits.
#pragma once

#include <optional>

#include "core.hpp"

namespace ckc {

// q_d with its first two derivatives: sums of sines, or a spline as polynomials in pieces.
struct Desired {
  Vector offset;
  Matrix amplitude, frequency, phase;  // (d, waves)
  Vector breaks;                       // (pieces + 1); none: sines
  std::vector<Matrix> coefficients;    // by power, highest first: (pieces, d)

  void operator()(double t, Out q, Out q_dot, Out q_ddot) const;
};

struct SetPoint {
  Matrix K_P, K_V;
  Vector q_d, h_d;
  double potential;  // energy at q_d
};

struct Tracking {
  Matrix Lambda, K_D;
  Desired desired;
};

class Drive {
 public:
  explicit Drive(int d, int n);

  Vector held;   // (d)
  Vector limit;  // (d), infinite where there is none
  std::optional<SetPoint> set_point;
  std::optional<Tracking> tracking;

  // After core.inertia and core.bias at the state: u, tau = u within its limits, u' on the tree.
  void act(double t, Core& core, In q, In q_dot);
  // d u / d q_dot of what is below its limit; leaves the core's C' at another velocity.
  void rate_gradient(double t, Core& core, In q, In q_dot, Matrix& gradient);
  // The controller's Lyapunov function, after `act`; w is what phi is.
  double lyapunov(const Core& core, double potential_energy, In q, In q_dot, In w);
  bool controls() const { return set_point || tracking; }
  Vector tau, u_tree;

 private:
  void track(double t, Core& core, In q, In q_dot);
  Vector q_d_, q_d_dot_, q_d_ddot_, v_, a_, r_, C_v_, tree_;
};

}  // namespace ckc
