#include "loops/predictor.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

Predictor::Predictor(const Core& core, double epsilon) : epsilon_(epsilon) {
  for (Point& point : points_) {
    point.q_tree.setZero(core.tree.nq), point.v_tree.setZero(core.n), point.w.setZero(core.rows.closure.rows);
  }
  level_.setZero(core.rows.closure.rows), step_.setZero(core.n), part_.setZero(core.n);
}

void Predictor::start(const Core& core, In q_tree) {
  for (Point& point : points_) point.rho = core.rho, point.phi_z = core.phi_z;
  dq_.setZero(core.d), far_.setZero(core.d), z_.setZero(core.z.size());
  count_ = 0, last_ = kept, off_ = false;
  points_[kept].q_tree = q_tree;
}

void Predictor::add(double t, const Core& core, In q_tree, In v_tree, In w) {
  int k = 0;
  while (k < count_ && points_[k].t != t) ++k;
  if (k == kept) {  // the furthest
    k = 0;
    for (int i = 1; i < kept; ++i)
      if (std::abs(points_[i].t - t) > std::abs(points_[k].t - t)) k = i;
  } else if (k == count_) {
    ++count_;
  }
  Point& point = points_[k];
  point.t = t, point.q_tree = q_tree, point.v_tree = v_tree, point.w = w, point.rho = core.rho;
  point.level = !w.isZero(0);
  off_ = off_ || point.level;
  if (off_) point.phi_z = core.phi_z;
  last_ = k;
}

void Predictor::predict(double t, In numbers, const Chart& chart, const Core& core, In w, Out q_tree) {
  int nearest = last_;
  double least = 0.0;
  for (int k = 0; k < count_; ++k) {
    chart.step(core, points_[k].q_tree, numbers, far_);
    double far = 0.0;  // one by one, as they were written
    for (int i = 0; i < core.d; ++i) far = std::max(far, std::abs(far_(i)));
    if (k == 0 || far < least) nearest = k, least = far, dq_ = far_;
  }
  Point& base = points_[nearest];
  int chosen[nodes] = {nearest};
  double a[nodes] = {1.0}, b[nodes] = {0.0};
  int count = count_ ? foretelling(t, nearest, chosen, a, b) : 1;
  foretold(base, count, chosen, a, b, core);
  if (count > 1 && missed(core) > least) {  // points of coarse steps lie beside the motion; weights magnify that
    count = 1, chosen[0] = nearest, a[0] = 1.0, b[0] = 0.0;
    step_.setZero();
  }
  if (!count_) chart.step(core, base.q_tree, numbers, dq_);
  for (int k = 0; k < core.d; ++k) {
    const double past = dq_(k);
    dq_(k) -= step_(core.q[k]);
    step_(core.q[k]) = past;
  }
  for (int z : core.z) step_(z) += base.rho.row(z).dot(dq_);
  if (off_ && count_) {
    level_ = w;
    for (int i = 0; i < count; ++i) level_ -= (a[i] - b[i] / epsilon_) * points_[chosen[i]].w;  // w_dot = -w / epsilon
    base.phi_z.solve(level_, z_);
    for (size_t k = 0; k < core.z.size(); ++k) step_(core.z[k]) += z_(k);
  }
  q_tree = base.q_tree;
  core.tree.integrate(q_tree, step_);
  if (!chart.plain()) return;
  for (int k = 0; k < core.d; ++k) q_tree(core.tree.place[core.q[k]]) = numbers(k);  // to the last digit
}

// The step from a point to what some foretell.
void Predictor::foretold(const Point& base, int count, const int* chosen, const double* a, const double* b,
                         const Core& core) {
  step_.setZero();
  if (count == 1) return;
  for (int i = 0; i < count; ++i) {
    const Point& point = points_[chosen[i]];
    core.tree.difference(base.q_tree, point.q_tree, part_);
    step_ += a[i] * part_;
    core.tree.difference_rate(base.q_tree, point.q_tree, point.v_tree, part_);
    step_ += b[i] * part_;
  }
}

// How far q, which is known, is from what has been foretold.
double Predictor::missed(const Core& core) const {
  double most = 0.0;
  for (int k = 0; k < core.d; ++k) most = std::max(most, std::abs(dq_(k) - step_(core.q[k])));
  return most;
}

int Predictor::foretelling(double t, int nearest, int* chosen, double* a, double* b) const {
  int order[kept];
  for (int k = 0; k < count_; ++k) order[k] = k;
  const auto away = [&](int k) { return std::abs(points_[k].t - t); };
  const int most = std::min(count_, nodes);
  for (int i = 0; i < most; ++i) {  // the nearest first
    int best = i;
    for (int k = i + 1; k < count_; ++k)
      if (away(order[k]) < away(order[best]) || (away(order[k]) == away(order[best]) && order[k] < order[best]))
        best = k;
    std::swap(order[i], order[best]);
  }
  if (away(order[0]) > 0.0) {
    for (int count = most; count > 1; --count) {
      double times[nodes], sum = 0.0;
      bool level = false;
      for (int i = 0; i < count; ++i) times[i] = points_[order[i]].t, level = level || points_[order[i]].level;
      hermite_weights(times, count, t, a, b);
      for (int i = 0; i < count; ++i) sum += std::abs(a[i]);
      if ((!level || away(order[count - 1]) < resolved * epsilon_) && sum < largest_weight) {
        std::copy(order, order + count, chosen);
        return count;
      }
    }
  }
  chosen[0] = nearest, a[0] = 1.0, b[0] = 0.0;  // to first order in q, whatever the time
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
