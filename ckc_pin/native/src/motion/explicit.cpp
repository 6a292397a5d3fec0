#include "motion/explicit.hpp"

#include <algorithm>
#include <cmath>

#include "motion/explicit_tables.hpp"

namespace ckc {

constexpr double safety = 0.9, min_factor = 0.2, max_factor = 10.0;
// Further reduction of the step size that the error proposes. Without it a third of the steps are rejected; with it the
// work is 7 % less.
constexpr double length_safety = 5.0 / 6.0;
constexpr double max_disagreement_for_growth = 0.3;  // relative to a disagreement that rejects a step
// Largest growth of the step size, unless two steps in a row ask for more: one may do so by chance.
constexpr double max_single_growth = 2.0;

namespace {

// Read a table of coefficients. If `triangular`, row i has i entries.
Matrix rows_of(const double* values, int rows, int columns, bool triangular) {
  Matrix a = Matrix::Zero(rows, columns);
  for (int i = triangular ? 1 : 0; i < rows; ++i)
    for (int j = 0; j < (triangular ? i : columns); ++j) a(i, j) = *values++;
  return a;
}

Vector vector_of(const double* values, int size) { return Eigen::Map<const Vector>(values, size); }

// sum += h * (linear combination of the first `count` rates). Zero coefficients are skipped, and numbers are
// processed in blocks so that their sums stay in registers.
template <class Coefficients>
void add_combination(const Matrix& rates, const Coefficients& coefficients, Eigen::Index count, double h, Out sum) {
  constexpr Eigen::Index block_size = 8, max_stages = 16;
  double factor[max_stages];
  const double* rate[max_stages];
  int count_used = 0;
  for (Eigen::Index i = 0; i < count; ++i)
    if (coefficients(i) != 0.0) factor[count_used] = h * coefficients(i), rate[count_used++] = rates.col(i).data();
  const Eigen::Index size = sum.size();
  Eigen::Index k = 0;
  for (; k + block_size <= size; k += block_size) {
    Eigen::Array<double, block_size, 1> x = sum.segment<block_size>(k);
    for (int i = 0; i < count_used; ++i)
      x += factor[i] * Eigen::Map<const Eigen::Array<double, block_size, 1>>(rate[i] + k);
    sum.segment<block_size>(k) = x;
  }
  for (; k < size; ++k) {
    double x = sum(k);
    for (int i = 0; i < count_used; ++i) x += factor[i] * rate[i][k];
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

// The stages that Lanes has computed, counted as if they had been evaluated here. False if there are not as many in the
// budget.
bool Explicit::take_computed_stages() {
  computed_.h = 0.0;
  if (work_.rhs + stages_ > work_.max_rhs) return false;
  for (int k = 0; k < stages_; ++k) count_computed_rhs();
  system_.set_last_rhs(step_.y_new);
  return true;
}

// Copy the rates that Lanes has computed to K_.
void Explicit::read_computed_rates() {
  const double* rate = computed_.rates;
  for (int s = 0; s <= stages_; ++s)
    for (Eigen::Index k = 0; k < K_.rows(); ++k, rate += computed_.stride) K_(k, s) = *rate;
  rates_are_computed_ = false;
}

bool Explicit::stages(double h) {
  rates_are_computed_ = h == computed_.h && step_.t == computed_.t && take_computed_stages();
  if (rates_are_computed_) return true;
  const bool full_motion = this->checks_full_motion(h);
  K_.col(0) = step_.f;
  if (full_motion) X_.resize(step_.x.size(), stages_ + 1), x_stage_.resize(step_.x.size()), X_.col(0) = step_.x_dot;
  for (int s = 1; s < stages_; ++s) {
    y_stage_ = step_.y;
    add_combination(K_, A_.row(s), s, h, y_stage_);
    if (!evaluate(step_.t + C_(s) * h, y_stage_, K_.col(s))) return false;
    if (full_motion) system_.full_motion(K_.col(s), x_stage_, X_.col(s));
  }
  step_.y_new = step_.y;
  add_combination(K_, B_, stages_, h, step_.y_new);
  if (!evaluate(step_.t + h, step_.y_new, step_.f_new)) return false;
  K_.col(stages_) = step_.f_new;
  if (step_.x.size()) system_.full_motion(step_.f_new, step_.x_new, step_.x_dot_new);
  if (full_motion) X_.col(stages_) = step_.x_dot_new;
  return true;
}

// Error of the full motion, which does not depend on the coordinates in y, and of the integrand.
double Explicit::error(double h) {
  const bool full_motion = this->checks_full_motion(h);
  const Eigen::Index motion_size = full_motion ? step_.x.size() : 0,
                     remaining_size = full_motion ? system_.size - system_.motion_size : step_.y.size();
  double square[2] = {0.0, 0.0};
  if (rates_are_computed_) std::copy_n(computed_.squares, 2, square);
  // In the order of Lanes, for the same digits.
  const auto add_weighted_error = [&](const Matrix& rates, const Vector& from, const Vector& to, Eigen::Index last) {
    scale_ = tolerance_.scale(from, to);
    for (int k = 0; k < (kind_ == dop853 ? 2 : 1); ++k) {
      error_.setZero(from.size());
      add_combination(rates, E_[k], stages_ + 1, 1.0, error_);
      for (Eigen::Index i = from.size() - last; i < from.size(); ++i) {
        const double ratio = error_(i) / scale_(i);
        square[k] += ratio * ratio;
      }
    }
  };
  if (motion_size) add_weighted_error(X_, step_.x, step_.x_new, motion_size);
  if (remaining_size && !rates_are_computed_) add_weighted_error(K_, step_.y, step_.y_new, remaining_size);
  const double size = static_cast<double>(motion_size + remaining_size),
               error_of_order_five = h * std::sqrt(square[0] / size);
  if (kind_ == rk45) return error_of_order_five;
  order_five_size_ = 0.5 * h, order_five_error_ = error_of_order_five;
  if (square[0] == 0.0 && square[1] == 0.0) return 0.0;
  return h * square[0] / std::sqrt((square[0] + 0.01 * square[1]) * size);
}

double Explicit::next_step_size(double t_bound) const {
  if (is_repeating()) return repeat_size_;
  const double min_size = min_step_size(t_bound);
  return std::clamp(step_.h, min_size, std::max(min_size, tolerance_.max_step));
}

double Explicit::order_five_step_size() const {
  return order_five_size_ * std::pow(std::max(order_five_error_, 1e-10), kind_ == dop853 ? -1.0 / 6.0 : -1.0 / 5.0);
}

bool Explicit::make_step(double t_bound) {
  const double min_size = min_step_size(t_bound), exponent = -1.0 / (error_order() + 1);
  const double step_size = next_step_size(t_bound);
  const bool is_repeat = is_repeating();
  has_dense_output_ = false, repeat_size_ = 0.0;
  if (!(step_size >= min_size)) return false;
  step_.t_new = std::min(step_.t + step_size, t_bound);
  const double h = step_.t_new - step_.t;
  const bool exists = stages(h);
  if (!exists && must_stop()) return false;
  double size = exists ? error(h) : std::numeric_limits<double>::infinity();
  bool agrees = true;
  double disagreement_size = 0.0;
  if (exists && checks_full_motion(h)) {
    x_stage_.noalias() = h * X_.leftCols(stages_) * B_;
    disagreement_size = disagreement(x_stage_);
    agrees = disagreement_size < 1.0;
    if (!agrees) size = std::max(size, disagreement_size);
  }
  if (!(size < 1.0)) {
    if (!agrees && !return_to_start()) return false;
    repeat_size_ = h * std::max(min_factor, exists ? safety * std::pow(size, exponent) : 0.0);
    return ++work_.rejected, false;
  }
  const double max_growth = is_repeat ? 1.0 : max_factor;
  double factor = length_safety * (size == 0.0 ? max_growth : std::min(max_growth, safety * std::pow(size, exponent)));
  // A disagreement between y and its rates may be rounding, which shorter steps do not reduce. Do not try a longer step.
  if (disagreement_size > max_disagreement_for_growth) factor = std::min(factor, 1.0);
  growth_next_ = step_.t_new < t_bound && factor > max_single_growth;
  step_.h_next = h * (growth_next_ && !growth_pending_ ? max_single_growth : factor);
  if (step_.t_new == t_bound && !is_repeat) step_.h_next = std::max(step_.h_next, step_.h);
  if (kind_ == rk45) order_five_size_ = h * length_safety * safety, order_five_error_ = size;
  return true;
}

void Explicit::reject_step(double step_size) {
  Method::reject_step(step_size);
  growth_pending_ = false;
}

void Explicit::accept_step() {
  Method::accept_step();
  growth_pending_ = growth_next_;
}

bool Explicit::extra_stages(double h) {
  for (Eigen::Index k = 0; k < C_extra_.size(); ++k) {
    const auto s = stages_ + 1 + k;
    y_stage_ = step_.y;
    add_combination(K_, A_extra_.row(k), s, h, y_stage_);
    if (!evaluate(step_.t + C_extra_(k) * h, y_stage_, K_.col(s))) return false;
  }
  return true;
}

bool Explicit::interpolate(double at, Out y_at) {
  const double h = step_.t_new - step_.t, x = (at - step_.t) / h;
  if (rates_are_computed_) read_computed_rates();
  if (!has_dense_output_ && kind_ == rk45) {
    F_.noalias() = h * K_ * D_;
  } else if (!has_dense_output_) {
    if (!extra_stages(h)) return false;
    F_.col(0) = step_.y_new - step_.y;
    F_.col(1) = h * step_.f - F_.col(0);
    F_.col(2) = 2 * F_.col(0) - h * (step_.f_new + step_.f);
    for (Eigen::Index k = 0; k < D_.rows(); ++k) {
      F_.col(3 + k).setZero();
      add_combination(K_, D_.row(k), K_.cols(), h, F_.col(3 + k));
    }
  }
  has_dense_output_ = true;
  y_at.setZero();
  for (Eigen::Index i = F_.cols() - 1; i >= 0; --i) {
    y_at += F_.col(i);
    y_at *= kind_ == rk45 || (F_.cols() - 1 - i) % 2 == 0 ? x : 1 - x;
  }
  y_at += step_.y;
  return true;
}

}  // namespace ckc
