#include "loops/predictor.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

Predictor::Predictor(const Core& core, double epsilon) : epsilon_(epsilon) {
  for (Point& point : points_) {
    point.q_tree.setZero(core.tree.nq), point.v_tree.setZero(core.n), point.w.setZero(core.constraints.closure.rows);
  }
  w_change_.setZero(core.constraints.closure.rows), step_.setZero(core.n), difference_.setZero(core.n);
}

void Predictor::reset(const Core& core, In q_tree, bool visits_level_sets) {
  for (Point& point : points_) {
    point.rho = core.rho;
    if (visits_level_sets) point.phi_z = core.phi_z;
  }
  dq_.setZero(core.d), distance_step_.setZero(core.d), z_.setZero(core.z.size());
  count_ = 0, last_point_ = max_points, visited_level_sets_ = false;
  points_[max_points].q_tree = q_tree;
}

void Predictor::add(double t, const Core& core, In q_tree, In v_tree, In w) {
  int k = 0;
  while (k < count_ && points_[k].t != t) ++k;
  if (k == max_points) {  // replace the most distant point
    k = 0;
    for (int i = 1; i < max_points; ++i)
      if (std::abs(points_[i].t - t) > std::abs(points_[k].t - t)) k = i;
  } else if (k == count_) {
    ++count_;
  }
  Point& point = points_[k];
  point.t = t, point.q_tree = q_tree, point.v_tree = v_tree, point.w = w, point.rho = core.rho;
  point.is_off_manifold = !w.isZero(0);
  visited_level_sets_ = visited_level_sets_ || point.is_off_manifold;
  if (visited_level_sets_) point.phi_z = core.phi_z;
  last_point_ = k;
}

void Predictor::predict(double t, In coordinates, const Chart& chart, const Core& core, In w, Out q_tree) {
  int nearest = last_point_;
  double shortest = 0.0;
  for (int k = 0; k < count_; ++k) {
    chart.tangent_step(core, points_[k].q_tree, coordinates, distance_step_);
    double distance = 0.0;  // a scalar loop, so that rounding does not depend on vectorization
    for (int i = 0; i < core.d; ++i) distance = std::max(distance, std::abs(distance_step_(i)));
    if (k == 0 || distance < shortest) nearest = k, shortest = distance, dq_ = distance_step_;
  }
  Point& base = points_[nearest];
  int chosen[max_nodes] = {nearest};
  double a[max_nodes] = {1.0}, b[max_nodes] = {0.0};
  int count = count_ ? choose_points(t, nearest, chosen, a, b) : 1;
  interpolate(base, count, chosen, a, b, core);
  // Interpolation magnifies the errors of large steps. Use the nearest point alone if it is closer.
  if (count > 1 && prediction_error(core) > shortest) {
    count = 1, chosen[0] = nearest, a[0] = 1.0, b[0] = 0.0;
    step_.setZero();
  }
  if (!count_) chart.tangent_step(core, base.q_tree, coordinates, dq_);
  for (int k = 0; k < core.d; ++k) {
    const double q_step = dq_(k);
    dq_(k) -= step_(core.q[k]);
    step_(core.q[k]) = q_step;
  }
  for (int z : core.z) step_(z) += base.rho.row(z).dot(dq_);
  if (visited_level_sets_ && count_) {
    w_change_ = w;
    // w_dot = -w / epsilon
    for (int i = 0; i < count; ++i) w_change_ -= (a[i] - b[i] / epsilon_) * points_[chosen[i]].w;
    base.phi_z.solve(w_change_, z_);
    for (size_t k = 0; k < core.z.size(); ++k) step_(core.z[k]) += z_(k);
  }
  q_tree = base.q_tree;
  core.tree.integrate(q_tree, step_);
  if (!chart.is_trivial()) return;
  for (int k = 0; k < core.d; ++k) q_tree(core.tree.q_index[core.q[k]]) = coordinates(k);  // exact to the last digit
}

// Tangent step from the base to the configuration that the chosen points predict.
void Predictor::interpolate(const Point& base, int count, const int* chosen, const double* a, const double* b,
                            const Core& core) {
  step_.setZero();
  if (count == 1) return;
  for (int i = 0; i < count; ++i) {
    const Point& point = points_[chosen[i]];
    core.tree.difference(base.q_tree, point.q_tree, difference_);
    step_ += a[i] * difference_;
    core.tree.difference_rate(base.q_tree, point.q_tree, point.v_tree, difference_);
    step_ += b[i] * difference_;
  }
}

// Distance between the q of the prediction and the given one.
double Predictor::prediction_error(const Core& core) const {
  double error = 0.0;
  for (int k = 0; k < core.d; ++k) error = std::max(error, std::abs(dq_(k) - step_(core.q[k])));
  return error;
}

int Predictor::choose_points(double t, int nearest, int* chosen, double* a, double* b) const {
  int order[max_points];
  for (int k = 0; k < count_; ++k) order[k] = k;
  const auto time_distance = [&](int k) { return std::abs(points_[k].t - t); };
  const int max_count = std::min(count_, max_nodes);
  for (int i = 0; i < max_count; ++i) {  // sort the nearest first
    int best = i;
    for (int k = i + 1; k < count_; ++k)
      if (time_distance(order[k]) < time_distance(order[best]) ||
          (time_distance(order[k]) == time_distance(order[best]) && order[k] < order[best]))
        best = k;
    std::swap(order[i], order[best]);
  }
  if (time_distance(order[0]) > 0.0) {
    for (int count = max_count; count > 1; --count) {
      double times[max_nodes], sum = 0.0;
      bool is_off_manifold = false;
      for (int i = 0; i < count; ++i)
        times[i] = points_[order[i]].t, is_off_manifold = is_off_manifold || points_[order[i]].is_off_manifold;
      hermite_weights(times, count, t, a, b);
      for (int i = 0; i < count; ++i) sum += std::abs(a[i]);
      if ((!is_off_manifold || time_distance(order[count - 1]) < max_time_constants * epsilon_) &&
          sum < max_weight_sum) {
        std::copy(order, order + count, chosen);
        return count;
      }
    }
  }
  chosen[0] = nearest, a[0] = 1.0, b[0] = 0.0;  // first order in q, independent of time
  return 1;
}

void hermite_weights(const double* times, int count, double t, double* a, double* b) {
  for (int i = 0; i < count; ++i) {
    double basis = 1.0, slope = 0.0;
    for (int j = 0; j < count; ++j) {
      if (j == i) continue;
      basis *= (t - times[j]) / (times[i] - times[j]);
      slope += 1.0 / (times[i] - times[j]);
    }
    a[i] = (1.0 - 2.0 * (t - times[i]) * slope) * basis * basis;
    b[i] = (t - times[i]) * basis * basis;
  }
}

}  // namespace ckc
