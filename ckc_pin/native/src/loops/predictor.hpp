// Where a motion has been on its level sets, and where z will be next.
//
// phi(q, z) = w makes z a function of (q, w) with the known slopes rho_z and phi_z^-1. Newton's method needs fewer
// iterations the better z is predicted: to first order from the nearest point visited, and along the motion, which is
// smooth in t, by Hermite interpolation through the last points and their rates.
#pragma once

#include "loops/chart.hpp"

namespace ckc {

class Predictor {
 public:
  Predictor(const Core& core, double epsilon);

  void start(const Core& core, In q_tree);  // forget; the first prediction is made from there
  // Take note of the core's configuration, closed on the level set w; the former one at t is lost.
  void add(double t, const Core& core, In q_tree, In v_tree, In w);
  // The configuration at q, `numbers` in a chart, with z as the points foretell it.
  void predict(double t, In numbers, const Chart& chart, const Core& core, In w, Out q_tree);

 private:
  static constexpr int kept = 8, nodes = 3;  // points; those of the interpolation, which is then of degree 5
  static constexpr double largest_weight = 1e3;  // sum of the weights' sizes: beyond, the points' errors are magnified
  static constexpr double resolved = 3.0;        // of epsilon: over longer times w's rate foretells nothing

  struct Point {
    double t = 0;
    Vector q_tree, v_tree, w;
    Matrix rho;
    Factor phi_z;
    bool level = false;  // w is not zero
  };

  void foretold(const Point& base, int count, const int* chosen, const double* a, const double* b, const Core& core);
  double missed(const Core& core) const;
  int foretelling(double t, int nearest, int* chosen, double* a, double* b) const;

  double epsilon_;
  Point points_[kept + 1];  // the last one is where it starts
  int count_ = 0, last_ = kept;
  bool off_ = false;
  Vector dq_, far_, level_, z_, step_, part_;
};

// Weights with p(t) = sum of a_i p(t_i) + b_i p'(t_i), exact for polynomials of degree 2 count - 1.
void hermite_weights(const double* times, int count, double t, double* a, double* b);

}  // namespace ckc
