#include "bdf.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ckc {

constexpr int max_iterations = 4;
constexpr double min_factor = 0.2, max_factor = 10.0, infinite = std::numeric_limits<double>::infinity();

Bdf::Bdf(Tolerance tolerance, double newton_tolerance, int size)
    : tolerance_(tolerance), newton_tolerance_(newton_tolerance) {
  constexpr double kappa[] = {0, -0.1850, -1.0 / 9, -0.0823, -0.0415, 0};
  gamma_[0] = 0;
  for (int k = 1; k <= most; ++k) gamma_[k] = gamma_[k - 1] + 1.0 / k;
  for (int k = 0; k <= most; ++k) {
    alpha_[k] = (1 - kappa[k]) * gamma_[k];
    error_[k] = kappa[k] * gamma_[k] + 1.0 / (k + 1);
  }
  for (Vector* x : {&y, &f, &y_new, &f_new, &y_old, &predicted_, &scale_, &psi_, &d_, &f_y_, &dy_, &right_}) x->setZero(size);
  for (Matrix* m : {&now.D, &next_.D, &changed_}) m->setZero(size, most + 3);
  J.setZero(size, size), matrix_.setZero(size, size);
  lu_.shape(size, size, full_pattern(size));
}

double Bdf::norm(In x) const {
  return std::sqrt((x.array() / scale_.array()).square().sum() / static_cast<double>(x.size()));
}

Bdf::Differences Bdf::ratio(int order, double factor) {
  Differences r = Differences::Zero();
  for (int j = 0; j <= order; ++j) {
    r(0, j) = 1.0;
    for (int i = 1; i <= order; ++i) r(i, j) = j ? r(i - 1, j) * (i - 1 - factor * j) / i : 0.0;
  }
  return r;
}

// The differences for steps `factor` times as long.
void Bdf::rescale(double factor) {
  const int order = next_.order;
  const Differences change = ratio(order, factor) * ratio(order, 1.0);
  for (int i = 0; i <= order; ++i) {
    changed_.col(i).setZero();
    for (int j = 0; j <= order; ++j) changed_.col(i) += change(j, i) * next_.D.col(j);
  }
  next_.D.leftCols(order + 1) = changed_.leftCols(order + 1);
  next_.equal = 0;
}

// Newton's method on the step's equation; `exists`: all right-hand sides did.
bool Bdf::solve(System& system, double c, int& iterations, bool& exists) {
  d_.setZero();
  y_new = predicted_;
  double before = 0.0, rate = -1.0;
  for (int k = 0; k < max_iterations; ++k) {
    iterations = k + 1;
    exists = evaluate(system, t_new, y_new, f_y_);
    if (!exists) return false;
    right_ = c * f_y_ - psi_ - d_;
    lu_.solve(right_, dy_);
    const double size = norm(dy_);
    if (k) rate = size / before;
    if (k && (rate >= 1 || std::pow(rate, max_iterations - k) / (1 - rate) * size > newton_tolerance_)) return false;
    y_new += dy_;
    d_ += dy_;
    if (size == 0 || (k && rate / (1 - rate) * size < newton_tolerance_)) return true;
    before = size;
  }
  return false;
}

bool Bdf::step(System& system, double t_bound) {
  const double least = 10 * (std::nextafter(t, infinite) - t);
  next_ = now;
  double length = std::clamp(h_abs, least, std::max(least, tolerance_.max_step));
  if (length != h_abs) rescale(length / h_abs);
  bool here = false;  // whether J is of this step
  const auto fail = [&] { return factored_ = false; };
  for (long tried = 0;; ++tried) {
    if (length < least) return fail();
    t_new = t + length;
    if (t_new > t_bound) {
      t_new = t_bound;
      rescale((t_new - t) / length);
      factored_ = false;
    }
    const double h = length = t_new - t;
    const int order = next_.order;
    predicted_ = next_.D.leftCols(order + 1).rowwise().sum();
    scale_ = tolerance_.atol + tolerance_.rtol * predicted_.array().abs();
    psi_.setZero();
    for (int k = 1; k <= order; ++k) psi_ += gamma_[k] / alpha_[order] * next_.D.col(k);
    const double c = h / alpha_[order];
    bool converged = false, exists = true;
    int iterations = 0;
    for (;;) {
      if (!factored_) {
        matrix_ = -c * J;
        matrix_.diagonal().array() += 1.0;
        lu_.compute(matrix_);
        factored_ = true, ++lu;
      }
      converged = solve(system, c, iterations, exists);
      if (!exists) return fail();
      if (converged || here) break;
      ++jacobians, rhs += system.core.d;
      if (!system.jacobian(t_new, predicted_, J)) return fail();
      here = true, factored_ = false;
    }
    if (!converged) {
      length *= 0.5;
      rescale(0.5);
      factored_ = false, ++rejected;
      continue;
    }
    const double safety = 0.9 * (2 * max_iterations + 1) / (2 * max_iterations + iterations);
    scale_ = tolerance_.atol + tolerance_.rtol * y_new.array().abs();
    const double size = error_[order] * norm(d_);
    if (std::abs(size) > 1) {
      const double factor = std::max(min_factor, safety * std::pow(std::abs(size), -1.0 / (order + 1)));
      length *= factor;
      rescale(factor);
      ++rejected;
      continue;
    }
    h_next = length;
    choose_order(safety, std::abs(size));
    return true;
  }
}

// Take note of the step in the differences; after enough equal ones choose order and length for the next.
void Bdf::choose_order(double safety, double error) {
  Matrix& D = next_.D;
  const int order = next_.order;
  ++next_.equal;
  D.col(order + 2) = d_ - D.col(order + 1);
  D.col(order + 1) = d_;
  for (int k = order; k >= 0; --k) D.col(k) += D.col(k + 1);
  if (next_.equal < order + 1) return;
  const double errors[] = {order > 1 ? std::abs(error_[order - 1]) * norm(D.col(order)) : infinite, error,
                           order < most ? std::abs(error_[order + 1]) * norm(D.col(order + 2)) : infinite};
  double best = -1.0;
  for (int k = 0; k < 3; ++k) {
    const double factor = std::pow(errors[k], -1.0 / (order + k));
    if (factor > best) best = factor, next_.order = order + k - 1;
  }
  const double factor = std::min(max_factor, safety * best);
  h_next *= factor;
  rescale(factor);
  factored_ = false;
}

void Bdf::commit() {
  Method::commit();
  std::swap(now.D, next_.D);
  now.order = next_.order, now.equal = next_.equal;
}

bool Bdf::between(System&, double at, Out y_at) {
  y_at = next_.D.col(0);
  double product = 1.0;
  for (int k = 0; k < next_.order; ++k) {
    product *= (at - (t_new - h_next * k)) / (h_next * (1 + k));
    y_at += product * next_.D.col(k + 1);
  }
  return true;
}

}  // namespace ckc
