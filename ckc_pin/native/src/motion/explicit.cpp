#include "motion/explicit.hpp"

#include <algorithm>
#include <cmath>

#include "motion/explicit_tables.hpp"

namespace ckc {

constexpr double safety = 0.9, min_factor = 0.2, max_factor = 10.0;
// Of the length that the error proposes, a third of which are refused: 7 % less work.
constexpr double step_safety = 5.0 / 6.0;
constexpr double near_refusal = 0.3;  // of a disagreement that refuses a step
// Of a step; more when two steps in a row ask for it, for one may do so by chance.
constexpr double growth = 2.0;

namespace {

// `first`: how many entries the first row has; each later one has one more if `triangular`.
Matrix rows_of(const double* values, int rows, int columns, bool triangular) {
  Matrix a = Matrix::Zero(rows, columns);
  for (int i = triangular ? 1 : 0; i < rows; ++i)
    for (int j = 0; j < (triangular ? i : columns); ++j) a(i, j) = *values++;
  return a;
}

Vector vector_of(const double* values, int size) { return Eigen::Map<const Vector>(values, size); }

// What the first rates make of h by their coefficients, many of which are zero. Some numbers of all rates after others, so
// that what they add up to stays in registers.
template <class Coefficients>
void add(const Matrix& rates, const Coefficients& of, Eigen::Index count, double h, Out sum) {
  constexpr Eigen::Index at_a_time = 8, most = 16;
  double factor[most];
  const double* rate[most];
  int used = 0;
  for (Eigen::Index i = 0; i < count; ++i)
    if (of(i) != 0.0) factor[used] = h * of(i), rate[used++] = rates.col(i).data();
  const Eigen::Index size = sum.size();
  Eigen::Index k = 0;
  for (; k + at_a_time <= size; k += at_a_time) {
    Eigen::Array<double, at_a_time, 1> x = sum.segment<at_a_time>(k);
    for (int i = 0; i < used; ++i) x += factor[i] * Eigen::Map<const Eigen::Array<double, at_a_time, 1>>(rate[i] + k);
    sum.segment<at_a_time>(k) = x;
  }
  for (; k < size; ++k) {
    double x = sum(k);
    for (int i = 0; i < used; ++i) x += factor[i] * rate[i][k];
    sum(k) = x;
  }
}

}  // namespace

Explicit::Explicit(Kind kind, System& system, Step& step, Work& work, const Tolerance& tolerance)
    : Method(system, step, work, tolerance), kind_(kind), stages_(kind == dop853 ? 12 : 6) {
  const int s = stages_, size = system.size;
  if (kind == dop853) {
    A_ = rows_of(dop853_A, s, s, true), A_extra_ = rows_of(dop853_A_extra, 3, 16, false);
    B_ = vector_of(dop853_B, s), C_ = vector_of(dop853_C, s), C_extra_ = vector_of(dop853_C_extra, 3);
    E_[0] = vector_of(dop853_E5, s + 1), E_[1] = vector_of(dop853_E3, s + 1);
    D_ = rows_of(dop853_D, 4, 16, false);
    F_.setZero(size, 7);
  } else {
    A_ = rows_of(rk45_A, s, s, true), B_ = vector_of(rk45_B, s), C_ = vector_of(rk45_C, s);
    E_[0] = vector_of(rk45_E, s + 1), D_ = rows_of(rk45_P, s + 1, 4, false);
    F_.setZero(size, 4);
  }
  K_.setZero(size, s + 1 + C_extra_.size());
  for (Vector* x : {&y_stage_, &scale_, &error_}) x->setZero(size);
}

bool Explicit::stages(double h) {
  const bool whole = this->whole(h);
  K_.col(0) = step_.f;
  if (whole) X_.resize(step_.x.size(), stages_ + 1), x_stage_.resize(step_.x.size()), X_.col(0) = step_.x_dot;
  for (int s = 1; s < stages_; ++s) {
    y_stage_ = step_.y;
    add(K_, A_.row(s), s, h, y_stage_);
    if (!evaluate(step_.t + C_(s) * h, y_stage_, K_.col(s))) return false;
    if (whole) system_.whole(K_.col(s), x_stage_, X_.col(s));
  }
  step_.y_new = step_.y;
  add(K_, B_, stages_, h, step_.y_new);
  if (!evaluate(step_.t + h, step_.y_new, step_.f_new)) return false;
  K_.col(stages_) = step_.f_new;
  if (step_.x.size()) system_.whole(step_.f_new, step_.x_new, step_.x_dot_new);
  if (whole) X_.col(stages_) = step_.x_dot_new;
  return true;
}

// Of the whole motion, so that it does not matter which coordinates y has, and of what y has beside it.
double Explicit::error(double h) {
  const bool whole = this->whole(h);
  const Eigen::Index moves = whole ? step_.x.size() : 0, rest = whole ? system_.beside() : step_.y.size();
  double square[2] = {0.0, 0.0};
  const auto look = [&](const Matrix& rates, const Vector& from, const Vector& to, Eigen::Index last) {
    scale_ = tolerance_.between(from, to);
    for (int k = 0; k < (kind_ == dop853 ? 2 : 1); ++k) {
      error_.setZero(from.size());
      add(rates, E_[k], stages_ + 1, 1.0, error_);
      square[k] += (error_.tail(last).array() / scale_.tail(last).array()).matrix().squaredNorm();
    }
  };
  if (moves) look(X_, step_.x, step_.x_new, moves);
  if (rest) look(K_, step_.y, step_.y_new, rest);
  const double size = static_cast<double>(moves + rest), of_five = h * std::sqrt(square[0] / size);
  if (kind_ == rk45) return of_five;
  reach_ = 0.5 * h * std::pow(std::max(of_five, 1e-10), -1.0 / 6.0);  // of RK45, whose error estimate is of order four
  if (square[0] == 0.0 && square[1] == 0.0) return 0.0;
  return h * square[0] / std::sqrt((square[0] + 0.01 * square[1]) * size);
}

bool Explicit::step(double t_bound) {
  const double least = shortest(t_bound), exponent = -1.0 / (error_order() + 1);
  double length = std::clamp(step_.h, least, std::max(least, tolerance_.max_step));
  dense_ = false;
  bool refused = false;
  for (;;) {
    if (!(length >= least)) return false;
    step_.t_new = std::min(step_.t + length, t_bound);
    const double h = step_.t_new - step_.t;
    length = h;
    const bool exists = stages(h);
    if (!exists && over()) return false;
    double size = exists ? error(h) : std::numeric_limits<double>::infinity();
    bool agrees = true;
    double rest = 0.0;
    if (exists && whole(h)) {
      x_stage_.noalias() = h * X_.leftCols(stages_) * B_;
      rest = disagreement(x_stage_);
      agrees = rest < 1.0;
      if (!agrees) size = std::max(size, rest);
    }
    if (size < 1.0) {
      const double most = refused ? 1.0 : max_factor;
      double factor = step_safety * (size == 0.0 ? most : std::min(most, safety * std::pow(size, exponent)));
      // What y tells differently from its rates may be rounding, which no shorter step makes less; no longer one is tried.
      if (rest > near_refusal) factor = std::min(factor, 1.0);
      growth_next_ = step_.t_new < t_bound && factor > growth;
      step_.h_next = length * (growth_next_ && !growth_pending_ ? growth : factor);
      if (step_.t_new == t_bound && !refused) step_.h_next = std::max(step_.h_next, step_.h);
      if (kind_ == rk45) reach_ = length * step_safety * safety * std::pow(std::max(size, 1e-10), exponent);
      return true;
    }
    if (!agrees && !return_to_start()) return false;
    length *= std::max(min_factor, exists ? safety * std::pow(size, exponent) : 0.0);
    refused = true;
    ++work_.rejected;
  }
}

void Explicit::retry(double length) {
  Method::retry(length);
  growth_pending_ = false;
}

void Explicit::commit() {
  Method::commit();
  growth_pending_ = growth_next_;
}

bool Explicit::extra_stages(double h) {
  for (Eigen::Index k = 0; k < C_extra_.size(); ++k) {
    const auto s = stages_ + 1 + k;
    y_stage_ = step_.y;
    add(K_, A_extra_.row(k), s, h, y_stage_);
    if (!evaluate(step_.t + C_extra_(k) * h, y_stage_, K_.col(s))) return false;
  }
  return true;
}

bool Explicit::between(double at, Out y_at) {
  const double h = step_.t_new - step_.t, x = (at - step_.t) / h;
  if (!dense_ && kind_ == rk45) {
    F_.noalias() = h * K_ * D_;
  } else if (!dense_) {
    if (!extra_stages(h)) return false;
    F_.col(0) = step_.y_new - step_.y;
    F_.col(1) = h * step_.f - F_.col(0);
    F_.col(2) = 2 * F_.col(0) - h * (step_.f_new + step_.f);
    for (Eigen::Index k = 0; k < D_.rows(); ++k) {
      F_.col(3 + k).setZero();
      add(K_, D_.row(k), K_.cols(), h, F_.col(3 + k));
    }
  }
  dense_ = true;
  y_at.setZero();
  for (Eigen::Index i = F_.cols() - 1; i >= 0; --i) {
    y_at += F_.col(i);
    y_at *= kind_ == rk45 || (F_.cols() - 1 - i) % 2 == 0 ? x : 1 - x;
  }
  y_at += step_.y;
  return true;
}

}  // namespace ckc
