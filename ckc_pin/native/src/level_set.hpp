// The reduced model, eq. 6, on a level set of phi; with w(t) of eq. 17 that is the SPF. Every q a joint of one freedom.
#pragma once

#include "system.hpp"
#include "trail.hpp"

namespace ckc {

class LevelSet : public System {
 public:
  LevelSet(Core& core, double epsilon, bool actual, In w0, double tolerance, double slack);

  Trail trail;

  void start(In q_tree);  // with the core's present partition
  void level(double t, Out w) const;
  // Close z at y = (q, q_dot), then rho and the tree's velocities; false where Newton's method does not get there.
  bool state(double t, In y, double tolerance);
  bool open(double t, In y) { return state(t, y, std::max(tolerance_, slack_)); }
  void finish(In u_tree, Out y_dot);  // after `open`
  bool jacobian(double t, In y, Matrix& jacobian) override;  // exact along q_dot, differences along q
  bool rhs(double t, In y, Out y_dot) override;              // `open` and `finish` with what drives
  bool exact(double t, In y) override { return state(t, y, tolerance_); }
  bool at_last(double, In) override { return true; }
  bool accept(double, Out, bool& changed) override { return changed = false, true; }
  double decay() const override { return -1.0 / epsilon_; }

 private:
  void accelerate(In u_tree, Out y_dot);
  bool newton(double tolerance);
  double unclosed();

  double epsilon_, tolerance_, slack_;
  bool actual_, on_manifold_;
  int expected_ = 0;  // corrections that closing will take
  Vector w0_, q_tree_, residual_, z_, moved_, y_dot_, tree_, step_;
  Vector f_, column_;
  Matrix gradient_, damping_;
};

}  // namespace ckc
