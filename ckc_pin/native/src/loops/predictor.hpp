// Predicts z from the last points of a motion on its level sets, as the initial guess of the projection.
//
// phi(q, z) = w makes z a function of (q, w) with the derivatives rho_z and phi_z^-1. A first-order prediction starts
// from the nearest point. Along the motion, which is smooth in t, Hermite polynomials through the last points and their
// rates predict more accurately.
#pragma once

#include "loops/chart.hpp"

namespace ckc {

class Predictor {
 public:
  Predictor(const Core& core, double epsilon);

  // Forget all points; the first prediction starts there. `visits_level_sets`: w may be different from zero.
  void reset(const Core& core, In q_tree, bool visits_level_sets);
  // Store the core's configuration, which is on the level set w. It replaces the point at the same t.
  void add(double t, const Core& core, In q_tree, In v_tree, In w);
  // Predict the configuration at q, given by its `coordinates` in a chart.
  void predict(double t, In coordinates, const Chart& chart, const Core& core, In w, Out q_tree);

 private:
  static constexpr int max_points = 8;               // stored
  static constexpr int max_nodes = 3;                // interpolated, by polynomials of degree 5
  static constexpr double max_weight_sum = 1e3;      // of |weights|; larger ones would magnify the errors of the points
  static constexpr double max_time_constants = 3.0;  // time in epsilon over which the rate of w predicts w

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
  Point points_[max_points + 1];  // points_[max_points]: the starting point
  int count_ = 0;                 // stored points
  int last_point_ = max_points;   // stored last
  bool visited_level_sets_ = false;
  Vector dq_, distance_step_, w_change_, z_, step_, difference_;
};

// Weights with p(t) = sum of a_i p(t_i) + b_i p'(t_i), exact for polynomials of degree 2 count - 1.
void hermite_weights(const double* times, int count, double t, double* a, double* b);

}  // namespace ckc
