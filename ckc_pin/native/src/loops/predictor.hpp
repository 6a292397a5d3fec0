// Predicts z from the last points of a motion on its level sets, as the initial guess of the projection.
//
// phi(q, z) = w makes z a function of (q, w) with the known derivatives rho_z and phi_z^-1. The prediction is of
// first order from the nearest point. Along the motion, which is smooth in t, the last points and their rates are
// interpolated by Hermite polynomials.
#pragma once

#include "loops/chart.hpp"

namespace ckc {

class Predictor {
 public:
  Predictor(const Core& core, double epsilon);

  void reset(const Core& core, In q_tree);  // forget all points; the first prediction starts there
  // Store the core's configuration, which is on the level set w. It replaces the point at the same t.
  void add(double t, const Core& core, In q_tree, In v_tree, In w);
  // Predict the configuration at q, given by its `numbers` in a chart.
  void predict(double t, In numbers, const Chart& chart, const Core& core, In w, Out q_tree);

 private:
  // points stored; points interpolated, with polynomials of degree 5
  static constexpr int max_points = 8, max_nodes = 3;
  // largest sum of |weights|; larger weights would magnify the points' errors
  static constexpr double largest_weight = 1e3;
  static constexpr double max_time_constants = 3.0;  // of epsilon: over longer times the rate of w predicts nothing

  struct Point {
    double t = 0;
    Vector q_tree, v_tree, w;
    Matrix rho;
    Factor phi_z;
    bool is_off_manifold = false;  // w is not zero
  };

  void interpolate(const Point& base, int count, const int* chosen, const double* a, const double* b, const Core& core);
  double prediction_error(const Core& core) const;
  int choose_points(double t, int nearest, int* chosen, double* a, double* b) const;

  double epsilon_;
  Point points_[max_points + 1];  // the last one is the starting point
  int count_ = 0, last_point_ = max_points;
  bool visited_level_sets_ = false;
  Vector dq_, distance_step_, w_change_, z_, step_, difference_;
};

// Weights with p(t) = sum of a_i p(t_i) + b_i p'(t_i), exact for polynomials of degree 2 count - 1.
void hermite_weights(const double* times, int count, double t, double* a, double* b);

}  // namespace ckc
