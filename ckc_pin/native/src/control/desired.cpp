#include "control/desired.hpp"

#include <algorithm>
#include <cmath>

#include "loops/predictor.hpp"

namespace ckc {

Harmonics::Harmonics(Vector offset, Matrix amplitude, Matrix frequency, Matrix phase)
    : offset_(std::move(offset)),
      amplitude_(std::move(amplitude)),
      frequency_(std::move(frequency)),
      phase_(std::move(phase)) {}

bool Harmonics::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  x = offset_, x_dot.setZero(), x_ddot.setZero();
  for (Eigen::Index k = 0; k < amplitude_.rows(); ++k)
    for (Eigen::Index i = 0; i < amplitude_.cols(); ++i) {
      const double rate = frequency_(k, i), angle = rate * t + phase_(k, i);
      const double sine = amplitude_(k, i) * std::sin(angle), cosine = amplitude_(k, i) * std::cos(angle);
      x(k) += sine, x_dot(k) += rate * cosine, x_ddot(k) -= rate * rate * sine;
    }
  return true;
}

Spline::Spline(Vector breaks, std::vector<Matrix> coefficients)
    : breaks_(std::move(breaks)), coefficients_(std::move(coefficients)) {}

bool Spline::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  const double* begin = breaks_.data();
  const auto pieces = breaks_.size() - 1;
  const auto piece = std::clamp<Eigen::Index>(std::upper_bound(begin, begin + pieces, t) - begin - 1, 0, pieces - 1);
  const double s = t - breaks_(piece);
  x.setZero(), x_dot.setZero(), x_ddot.setZero();
  for (const Matrix& c : coefficients_) {  // Horner, with both derivatives
    x_ddot = x_ddot * s + 2 * x_dot;
    x_dot = x_dot * s + x;
    x = x * s + c.row(piece).transpose();
  }
  return true;
}

constexpr int most_steps = 20;
constexpr double longest = 0.5;  // rad or m: a longer Newton step in one coordinate is not local any more
constexpr double largest_weight = 10.0;  // sum of the weights' sizes, of an interpolation between knots

PointMotion::PointMotion(const std::string& model, Indices place, Task task, std::unique_ptr<Motion> path, Indices q,
                         Vector times, Matrix knots, double tolerance, double end, std::string past_end)
    : tree_(model, std::move(place)),
      rows_(tree_, task.closure),
      task_(std::move(task)),
      path_(std::move(path)),
      q_(std::move(q)),
      times_(std::move(times)),
      knots_(std::move(knots)),
      tolerance_(tolerance),
      end_(end),
      past_end_(std::move(past_end)) {
  const int n = tree_.n;
  q_tree_.setZero(tree_.nq), J_dot_v_.setZero(rows_.closure.rows), J_.setZero(n, n), units_.setOnes(n);
  for (Vector* x : {&v_, &a_, &wanted_, &residual_, &step_}) x->setZero(n);
  for (Vector* x : {&x_, &x_dot_, &x_ddot_}) x->setZero(3);
  factor_.shape(n, n, full_pattern(n));
  rates_.setZero(n, times_.size()), known_.assign(times_.size(), 0);
}

bool PointMotion::place() {
  tree_.set(q_tree_);
  rows_.set(tree_, q_tree_);
  rows_.jacobian(tree_);
  for (int i = 0; i < tree_.n; ++i) J_.row(i) = rows_.J.row(task_.psi[i]);
  factor_.compute(J_);
  return !factor_.singular() && rows_.phi.allFinite();
}

// Newton's method from q_tree_; false where a step is not local or does not contract.
bool PointMotion::close() {
  const double tolerance = tolerance_ * tree_.coarseness(q_tree_, units_);
  double before = 0.0;
  for (int k = 0; k < most_steps; ++k) {
    const bool exists = place();
    for (int i = 0; i < tree_.n; ++i) residual_(i) = rows_.phi(task_.psi[i]) - wanted_(i);
    const double size = residual_.lpNorm<Eigen::Infinity>();
    if (!exists || (k && !(size <= std::max(0.5 * before, tolerance)))) return false;
    if (size <= tolerance) return true;
    factor_.solve(residual_, step_);
    if (!(step_.lpNorm<Eigen::Infinity>() <= longest)) return false;
    step_ = -step_;
    tree_.integrate(q_tree_, step_);
    before = size;
  }
  return false;
}

void PointMotion::fill(const Vector& path, const Vector* level) {
  for (int i = 0; i < tree_.n; ++i) wanted_(i) = task_.axis[i] >= 0 ? path(task_.axis[i]) : level ? (*level)(i) : 0.0;
}

bool PointMotion::knot_rate(Eigen::Index knot) {
  if (known_[knot]) return true;
  q_tree_ = knots_.col(knot);
  if (!(*path_)(times_(knot), x_, x_dot_, x_ddot_) || !place()) return false;
  fill(x_dot_, nullptr);
  factor_.solve(wanted_, rates_.col(knot));
  known_[knot] = rates_.col(knot).allFinite();
  return known_[knot];
}

bool PointMotion::predict(double t, Eigen::Index first) {
  const auto regular = times_.size() - (std::isfinite(end_) ? 1 : 0);
  double a[nodes], b[nodes], sum = 0.0;
  for (int i = 0; i < nodes; ++i)
    if (first + i >= regular || !knot_rate(first + i)) return false;
  hermite_weights(times_.data() + first, nodes, t, a, b);
  for (double weight : a) sum += std::abs(weight);
  if (!(sum < largest_weight)) return false;
  q_tree_ = knots_.col(first);
  step_.setZero();
  for (int i = 0; i < nodes; ++i) {
    tree_.difference(q_tree_, knots_.col(first + i), v_);
    tree_.difference_rate(q_tree_, knots_.col(first + i), rates_.col(first + i), a_);
    step_ += a[i] * v_ + b[i] * a_;
  }
  tree_.integrate(q_tree_, step_);
  return true;
}

bool PointMotion::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  if (t > end_) {
    problem = past_end_;
    return false;
  }
  // the knots around t, the nearer one first; the last one may be singular, at the workspace's edge
  const double* begin = times_.data();
  const auto count = times_.size();
  const auto after = std::clamp<Eigen::Index>(std::lower_bound(begin, begin + count, t) - begin, 1, count - 1);
  const bool before = t - times_(after - 1) < times_(after) - t;
  const bool predicted = predict(t, std::max<Eigen::Index>(after - (before ? 2 : 1), 0));
  if (!(*path_)(t, x_, x_dot_, x_ddot_)) return false;
  fill(x_, &task_.level);
  bool closed = predicted && close();
  for (const auto knot : {before ? after - 1 : after, before ? after : after - 1}) {
    if (closed) break;
    q_tree_ = knots_.col(knot);
    closed = close();
  }
  if (!closed) {
    problem = "the desired path of the point cannot be followed here";
    return false;
  }
  fill(x_dot_, nullptr);
  factor_.solve(wanted_, v_);
  tree_.bias(q_tree_, v_);
  rows_.rates(tree_);
  rows_.bias(J_dot_v_);
  fill(x_ddot_, nullptr);
  for (int i = 0; i < tree_.n; ++i) wanted_(i) -= J_dot_v_(task_.psi[i]);
  factor_.solve(wanted_, a_);
  for (size_t k = 0; k < q_.size(); ++k) {
    x(k) = q_tree_(tree_.place[q_[k]]), x_dot(k) = v_(q_[k]), x_ddot(k) = a_(q_[k]);
  }
  return true;
}

}  // namespace ckc
