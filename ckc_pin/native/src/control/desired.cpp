#include "control/desired.hpp"

#include <algorithm>
#include <cmath>

#include "loops/predictor.hpp"

namespace ckc {

HarmonicTrajectory::HarmonicTrajectory(Vector offset, Matrix amplitude, Matrix frequency, Matrix phase)
    : offset_(std::move(offset)),
      amplitude_(std::move(amplitude)),
      frequency_(std::move(frequency)),
      phase_(std::move(phase)) {}

bool HarmonicTrajectory::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  x = offset_, x_dot.setZero(), x_ddot.setZero();
  for (Eigen::Index k = 0; k < amplitude_.rows(); ++k)
    for (Eigen::Index i = 0; i < amplitude_.cols(); ++i) {
      const double rate = frequency_(k, i), angle = rate * t + phase_(k, i);
      const double sine = amplitude_(k, i) * std::sin(angle), cosine = amplitude_(k, i) * std::cos(angle);
      x(k) += sine, x_dot(k) += rate * cosine, x_ddot(k) -= rate * rate * sine;
    }
  return true;
}

SplineTrajectory::SplineTrajectory(Vector breaks, std::vector<Matrix> coefficients)
    : breaks_(std::move(breaks)), coefficients_(std::move(coefficients)) {}

Eigen::Index SplineTrajectory::piece_at(double t) const {
  const double* begin = breaks_.data();
  const auto pieces = breaks_.size() - 1;
  return std::clamp<Eigen::Index>(std::upper_bound(begin, begin + pieces, t) - begin - 1, 0, pieces - 1);
}

void SplineTrajectory::set_segment(double begin, double end, double tolerance) {
  first_ = piece_at(begin + tolerance), last_ = std::max(first_, piece_at(end - tolerance));
  begin_ = begin - tolerance, end_ = end + tolerance;
}

bool SplineTrajectory::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  auto piece = piece_at(t);
  if (t >= begin_ && t <= end_) piece = std::clamp(piece, first_, last_);
  const double s = t - breaks_(piece);
  x.setZero(), x_dot.setZero(), x_ddot.setZero();
  for (const Matrix& c : coefficients_) {  // Horner's scheme with both derivatives
    x_ddot = x_ddot * s + 2 * x_dot;
    x_dot = x_dot * s + x;
    x = x * s + c.row(piece).transpose();
  }
  return true;
}

SumTrajectory::SumTrajectory(std::vector<std::unique_ptr<Trajectory>> parts, Eigen::Index size)
    : parts_(std::move(parts)), x_(size), x_dot_(size), x_ddot_(size) {}

bool SumTrajectory::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  x.setZero(), x_dot.setZero(), x_ddot.setZero();
  for (const auto& part : parts_) {
    if (!(*part)(t, x_, x_dot_, x_ddot_)) return failure = part->failure, false;
    x += x_, x_dot += x_dot_, x_ddot += x_ddot_;
  }
  return true;
}

void SumTrajectory::set_segment(double begin, double end, double tolerance) {
  for (const auto& part : parts_) part->set_segment(begin, end, tolerance);
}

constexpr int max_newton_steps = 20;
constexpr double max_newton_step = 0.5;  // rad or m; longer steps may change the branch
constexpr double max_weight_sum = 10.0;  // of |weights| in an interpolation between knots

PointTrajectory::PointTrajectory(Task task, std::unique_ptr<Trajectory> path, Indices q, Knots knots, double tolerance)
    : tree_(task.model, task.q_index),
      constraints_(tree_, task.closure),
      task_(std::move(task)),
      path_(std::move(path)),
      q_(std::move(q)),
      knots_(std::move(knots)),
      tolerance_(tolerance) {
  const int n = tree_.n;
  q_tree_.setZero(tree_.nq), J_dot_v_.setZero(constraints_.closure.rows), J_.setZero(n, n), units_.setOnes(n);
  for (Vector* x : {&v_, &a_, &target_, &residual_, &step_}) x->setZero(n);
  for (Vector* x : {&x_, &x_dot_, &x_ddot_}) x->setZero(3);
  factor_.set_pattern(n, n, full_pattern(n));
  rates_.setZero(n, knots_.times.size()), rate_is_known_.assign(knots_.times.size(), 0);
}

bool PointTrajectory::update_rows() {
  tree_.set_configuration(q_tree_);
  constraints_.update(tree_, q_tree_);
  constraints_.update_jacobian(tree_);
  for (int i = 0; i < tree_.n; ++i) J_.row(i) = constraints_.J().row(task_.psi[i]);
  factor_.compute(J_);
  return !factor_.singular() && constraints_.phi.allFinite();
}

// Newton's method from q_tree_. False if a step is too long or does not contract.
bool PointTrajectory::solve() {
  const double tolerance = tolerance_ * tree_.tolerance_scale(q_tree_, units_);
  double previous_size = 0.0;
  for (int k = 0; k < max_newton_steps; ++k) {
    const bool is_regular = update_rows();
    for (int i = 0; i < tree_.n; ++i) residual_(i) = constraints_.phi(task_.psi[i]) - target_(i);
    const double size = residual_.lpNorm<Eigen::Infinity>();
    if (!is_regular || (k && !(size <= std::max(0.5 * previous_size, tolerance)))) return false;
    if (size <= tolerance) return true;
    factor_.solve(residual_, step_);
    if (!(step_.lpNorm<Eigen::Infinity>() <= max_newton_step)) return false;
    step_ = -step_;
    tree_.integrate(q_tree_, step_);
    previous_size = size;
  }
  return false;
}

void PointTrajectory::set_target(const Vector& path, const Vector* level) {
  for (int i = 0; i < tree_.n; ++i) target_(i) = task_.axis[i] >= 0 ? path(task_.axis[i]) : level ? (*level)(i) : 0.0;
}

bool PointTrajectory::compute_knot_rate(Eigen::Index knot) {
  if (rate_is_known_[knot]) return true;
  q_tree_ = knots_.configurations.col(knot);
  if (!(*path_)(knots_.times(knot), x_, x_dot_, x_ddot_) || !update_rows()) return false;
  set_target(x_dot_, nullptr);
  factor_.solve(target_, rates_.col(knot));
  rate_is_known_[knot] = rates_.col(knot).allFinite();
  return rate_is_known_[knot];
}

bool PointTrajectory::predict(double t, Eigen::Index first) {
  const auto regular = knots_.times.size() - (std::isfinite(knots_.end) ? 1 : 0);
  double a[nodes], b[nodes], sum = 0.0;
  for (int i = 0; i < nodes; ++i)
    if (first + i >= regular || !compute_knot_rate(first + i)) return false;
  hermite_weights(knots_.times.data() + first, nodes, t, a, b);
  for (double weight : a) sum += std::abs(weight);
  if (!(sum < max_weight_sum)) return false;
  q_tree_ = knots_.configurations.col(first);
  step_.setZero();
  for (int i = 0; i < nodes; ++i) {
    tree_.difference(q_tree_, knots_.configurations.col(first + i), v_);
    tree_.difference_rate(q_tree_, knots_.configurations.col(first + i), rates_.col(first + i), a_);
    step_ += a[i] * v_ + b[i] * a_;
  }
  tree_.integrate(q_tree_, step_);
  return true;
}

bool PointTrajectory::operator()(double t, Out x, Out x_dot, Out x_ddot) {
  if (t > knots_.end) {
    failure = knots_.past_end_message;
    return false;
  }
  // Try the knots around t, the nearer one first. The last one may be singular, at the edge of the workspace.
  const double* begin = knots_.times.data();
  const auto count = knots_.times.size();
  const auto after = std::clamp<Eigen::Index>(std::lower_bound(begin, begin + count, t) - begin, 1, count - 1);
  const bool previous_is_nearer = t - knots_.times(after - 1) < knots_.times(after) - t;
  const bool predicted = predict(t, std::max<Eigen::Index>(after - (previous_is_nearer ? 2 : 1), 0));
  if (!(*path_)(t, x_, x_dot_, x_ddot_)) return false;
  set_target(x_, &task_.level);
  bool closed = predicted && solve();
  for (const auto knot : {previous_is_nearer ? after - 1 : after, previous_is_nearer ? after : after - 1}) {
    if (closed) break;
    q_tree_ = knots_.configurations.col(knot);
    closed = solve();
  }
  if (!closed) {
    failure = "the desired path of the point cannot be followed here";
    return false;
  }
  set_target(x_dot_, nullptr);
  factor_.solve(target_, v_);
  tree_.compute_bias(q_tree_, v_);
  constraints_.update_rates(tree_, tree_, v_);
  constraints_.bias(J_dot_v_);
  set_target(x_ddot_, nullptr);
  for (int i = 0; i < tree_.n; ++i) target_(i) -= J_dot_v_(task_.psi[i]);
  factor_.solve(target_, a_);
  for (size_t k = 0; k < q_.size(); ++k) {
    x(k) = q_tree_(tree_.q_index[q_[k]]), x_dot(k) = v_(q_[k]), x_ddot(k) = a_(q_[k]);
  }
  return true;
}

}  // namespace ckc
