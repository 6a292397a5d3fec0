#include <algorithm>
#include <cmath>
#include <limits>

#include "method.hpp"

namespace ckc {

constexpr int stages_ = 12;
constexpr double safety = 0.9, min_factor = 0.2, max_factor = 10.0, exponent = -1.0 / 8.0;
constexpr double caution = 5.0 / 6.0, growth = 2.0;  // as in `simulation.integrate`

Dop853::Dop853(Table table, Tolerance tolerance, int size) : table_(std::move(table)), tolerance_(tolerance) {
  K_.setZero(size, stages_ + 1 + table_.C_extra.size());
  F_.setZero(size, 3 + table_.D.rows());
  for (Vector* x : {&y, &f, &y_new, &f_new, &y_old, &y_stage_, &scale_, &error_}) x->setZero(size);
}

bool Dop853::stages(System& system, double h) {
  K_.col(0) = f;
  for (int s = 1; s < stages_; ++s) {
    y_stage_ = y;
    for (int i = 0; i < s; ++i)
      if (table_.A(s, i) != 0.0) y_stage_ += (h * table_.A(s, i)) * K_.col(i);
    if (!evaluate(system, t + table_.C(s) * h, y_stage_, K_.col(s))) return false;
  }
  y_new = y;
  for (int s = 0; s < stages_; ++s) y_new += (h * table_.B(s)) * K_.col(s);
  if (!evaluate(system, t + h, y_new, f_new)) return false;
  K_.col(stages_) = f_new;
  return true;
}

double Dop853::error(double h) {
  scale_ = tolerance_.atol + tolerance_.rtol * y.cwiseAbs().cwiseMax(y_new.cwiseAbs()).array();
  double square[2];
  for (int k : {0, 1}) {
    const Vector& E = k ? table_.E3 : table_.E5;
    error_.setZero();
    for (int s = 0; s <= stages_; ++s) error_ += E(s) * K_.col(s);
    square[k] = (error_.array() / scale_.array()).matrix().squaredNorm();
  }
  if (square[0] == 0.0 && square[1] == 0.0) return 0.0;
  return std::abs(h) * square[0] / std::sqrt((square[0] + 0.01 * square[1]) * static_cast<double>(y.size()));
}

bool Dop853::step(System& system, double t_bound) {
  const double least = 10 * (std::nextafter(t, std::numeric_limits<double>::infinity()) - t);
  double length = std::clamp(h_abs, least, std::max(least, tolerance_.max_step));
  dense_ = false;
  bool refused = false;
  for (;;) {
    if (length < least) return false;
    t_new = std::min(t + length, t_bound);
    const double h = t_new - t;
    length = h;
    if (!stages(system, h)) return false;
    const double size = error(h);
    if (size < 1.0) {
      const double most = refused ? 1.0 : max_factor;
      const double factor = caution * (size == 0.0 ? most : std::min(most, safety * std::pow(size, exponent)));
      growing_next = t_new < t_bound && factor > growth;
      h_next = length * (growing_next && !growing ? growth : factor);
      return true;
    }
    length *= std::max(min_factor, safety * std::pow(size, exponent));
    refused = true;
    ++rejected;
  }
}

bool Dop853::again(double length) {
  h_abs = length, growing = false;
  ++rejected;
  return true;
}

bool Dop853::adopt(System& system, double to, In y_to, double length) {
  t_new = to, y_new = y_to, h_next = length, growing_next = false;
  return evaluate(system, t_new, y_new, f_new);
}

bool Dop853::between(System& system, double at, Out y_at) {
  const double h = t_new - t;
  if (!dense_) {
    for (Eigen::Index k = 0; k < table_.C_extra.size(); ++k) {
      const auto s = stages_ + 1 + k;
      y_stage_ = y;
      for (Eigen::Index i = 0; i < s; ++i)
        if (table_.A_extra(k, i) != 0.0) y_stage_ += (h * table_.A_extra(k, i)) * K_.col(i);
      if (!evaluate(system, t + table_.C_extra(k) * h, y_stage_, K_.col(s))) return false;
    }
    F_.col(0) = y_new - y;
    F_.col(1) = h * f - F_.col(0);
    F_.col(2) = 2 * F_.col(0) - h * (f_new + f);
    for (Eigen::Index k = 0; k < table_.D.rows(); ++k) {
      F_.col(3 + k).setZero();
      for (Eigen::Index i = 0; i < K_.cols(); ++i) F_.col(3 + k) += (h * table_.D(k, i)) * K_.col(i);
    }
    dense_ = true;
  }
  const double x = (at - t) / h;
  y_at.setZero();
  for (Eigen::Index i = 0; i < F_.cols(); ++i) {
    y_at += F_.col(F_.cols() - 1 - i);
    y_at *= i % 2 == 0 ? x : 1 - x;
  }
  y_at += y;
  return true;
}

}  // namespace ckc
