// Where a motion has been on its level sets, and where z will be next: `simulation.systems.trail`, where every q is
// a joint of one freedom.
#pragma once

#include "core.hpp"

namespace ckc {

class Trail {
 public:
  Trail(const Core& core, double epsilon);

  void start(const Core& core, In q_tree);  // forget; the first prediction is made from there
  // Take note of the core's configuration, closed on the level set w; the former one at t is lost.
  void add(double t, const Core& core, In q_tree, In v_tree, In w);
  void predict(double t, In q, const Core& core, In w, Out q_tree);
  const Vector& last() const { return points_[last_].q_tree; }

 private:
  static constexpr int kept = 8, nodes = 3;
  static constexpr double largest_weight = 1e3, resolved = 3.0;

  struct Point {
    double t = 0;
    Vector q_tree, v_tree, w;
    Matrix rho;
    Factor phi_z;
    bool level = false;  // w is not zero
  };

  int foretelling(double t, int nearest, int* chosen, double* a, double* b) const;

  double epsilon_;
  Point points_[kept + 1];  // the last one is where it starts
  int count_ = 0, last_ = kept;
  bool off_ = false;
  Vector dq_, level_, z_, step_, part_;
};

// Weights with p(t) = sum of a_i p(t_i) + b_i p'(t_i), exact for polynomials of degree 2 count - 1.
void hermite_weights(const double* times, int count, double t, double* a, double* b);

}  // namespace ckc
