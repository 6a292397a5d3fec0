#include "motion/lanes.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

// With fewer members, computing each alone takes less time.
constexpr int min_members = 3;

namespace {

constexpr int width = Lanes::width;
using Members = CompiledTerms::Members;

// sum = start + (coefficients[0] * factor) * rates[0] + ... of vectors of `size` numbers
WITH_WIDEST_REGISTERS void add_products(const Members* start, const Members* const* rates, const double* coefficients,
                                        const Members& factor, int count, int size, Members* sum) {
  constexpr int block_size = 4;  // numbers whose sums stay in registers, and do not wait for one another
  int k = 0;
  for (; k + block_size <= size; k += block_size) {
    Vector8 x[block_size];
    for (int j = 0; j < block_size; ++j) x[j] = vector_of(start[k + j]);
    for (int i = 0; i < count; ++i)
      for (int j = 0; j < block_size; ++j) x[j] += coefficients[i] * vector_of(factor) * vector_of(rates[i][k + j]);
    for (int j = 0; j < block_size; ++j) vector_of(sum[k + j]) = x[j];
  }
  for (; k < size; ++k) {
    Vector8 x = vector_of(start[k]);
    for (int i = 0; i < count; ++i) x += coefficients[i] * vector_of(factor) * vector_of(rates[i][k]);
    vector_of(sum[k]) = x;
  }
}

// sum of (error / (rtol * max(|from|, |to|) + atol))^2
WITH_WIDEST_REGISTERS void add_squares(const Members* error, const Members* from, const Members* to,
                                       const Members& rtol, const Members& atol, int size, Members& sum) {
  Vector8 squares = {};
  for (int k = 0; k < size; ++k) {
    Vector8 a = vector_of(from[k]), b = vector_of(to[k]);
    make_absolute(a), make_absolute(b);
    const Vector8 ratio = vector_of(error[k]) / (vector_of(rtol) * (a < b ? b : a) + vector_of(atol));
    squares += ratio * ratio;
  }
  vector_of(sum) = squares;
}

// Members all of whose numbers are finite get 0, the others NaN.
WITH_WIDEST_REGISTERS void find_not_finite(const Members* x, int size, Members& result) {
  Vector8 sum = {};
  for (int k = 0; k < size; ++k) sum += 0.0 * vector_of(x[k]);
  vector_of(result) = sum;
}

}  // namespace

void Lanes::set_constants(int lane, const Vector& constants) {
  if (constants_.size() != static_cast<size_t>(constants.size())) {
    constants_.resize(static_cast<size_t>(constants.size()));
    for (size_t k = 0; k < constants_.size(); ++k) std::fill_n(constants_[k].of, width, constants(k));
  }
  for (size_t k = 0; k < constants_.size(); ++k) constants_[k].of[lane] = constants(k);
}

void Lanes::compute(const Attempts& attempts) {
  for (Explicit::Kind kind : {Explicit::dop853, Explicit::rk45}) compute(attempts, kind);
}

void Lanes::compute(const Attempts& attempts, Explicit::Kind kind) {
  int first = -1, count = 0;
  for (int lane = 0; lane < width; ++lane) {
    Explicit* method = attempts[lane].method;
    methods_[lane] = method && method->kind_ == kind && method->system_.terms_of_rate() ? method : nullptr;
    if (methods_[lane]) ++count, first = first < 0 ? lane : first;
  }
  if (count < min_members) return;
  const Explicit& method = *methods_[first];
  const int stages = method.stages_;
  start(attempts, method);
  for (int lane = 0; lane < width; ++lane)  // lanes without a member repeat one that has
    if (!methods_[lane]) {
      for (Lines* x : {&start_, &rates_})
        for (int k = 0; k < size_; ++k) (*x)[k].of[lane] = (*x)[k].of[first];
      for (Members* x : {&h_, &rtol_, &atol_}) x->of[lane] = x->of[first];
      t_[lane] = t_[first];
    }
  compute_unknown_starts(attempts);
  for (int s = 1; s < stages; ++s) combine(start_, method.A_.row(s), s, h_, y_), evaluate(method.C_(s), s);
  combine(start_, method.B_, stages, h_, y_);
  evaluate(1.0, stages);
  Members not_finite, one, squares[2];
  find_not_finite(y_.data(), size_, not_finite);
  std::fill_n(one.of, width, 1.0);
  for (int k = 0; k < (kind == Explicit::dop853 ? 2 : 1); ++k) {
    combine(zero_, method.E_[k], stages + 1, one, error_);
    add_squares(error_.data(), start_.data(), y_.data(), rtol_, atol_, size_, squares[k]);
  }
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane] || not_finite.of[lane] != 0.0) continue;
    Explicit& of_lane = *methods_[lane];
    Step& step = of_lane.step_;
    const Members* f_new = &rates_[stages * size_];
    for (int k = 0; k < size_; ++k) step.y_new(k) = y_[k].of[lane], step.f_new(k) = f_new[k].of[lane];
    of_lane.computed_ = {t_[lane], h_.of[lane], {squares[0].of[lane], squares[1].of[lane]}, &rates_[0].of[lane], width};
  }
  compute_ends(attempts);
}

void Lanes::compute_ends(const Attempts& attempts) {
  int first = -1;
  for (int lane = width - 1; lane >= 0; --lane)
    if (methods_[lane] && attempts[lane].end) first = lane;
  if (first < 0 || !terms_->has_ends()) return;
  const System& system = methods_[first]->system_;
  ends_.compute(system.core, system.projection_tolerance(), constants_.data(), y_.data(), trig_.data(), rtol_, atol_);
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane] || !attempts[lane].end || !ends_.read(lane, *attempts[lane].end)) continue;
    attempts[lane].end->t = t_[lane], attempts[lane].end->t_new = t_[lane] + h_.of[lane];
    ++end_count;
  }
}

void Lanes::start(const Attempts& attempts, const Explicit& first) {
  terms_ = first.system_.terms_of_rate();
  n_ = first.system_.core.n, size_ = first.system_.size;
  for (Lines* x : {&start_, &y_, &error_, &zero_}) x->resize(size_);
  rates_.resize(size_ * (first.stages_ + 1));
  trig_.resize(2 * n_), force_.resize(n_);
  correction_.resize(std::max(first.system_.core.constraints.closure.rows, 1));  // a tree's has an address too
  for (Vector* x : {&q_tree_, &v_, &applied_}) x->setZero(n_);
  has_force_ = false;
  std::fill(force_.begin(), force_.end(), Members{});
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane]) continue;
    const Explicit& method = *methods_[lane];
    has_force_ = has_force_ || method.system_.has_applied_force();
    const Step& step = method.step_;
    t_[lane] = step.t;
    h_.of[lane] = std::min(step.t + method.next_step_size(attempts[lane].bound), attempts[lane].bound) - step.t;
    rtol_.of[lane] = method.tolerance_.rtol, atol_.of[lane] = method.tolerance_.atol;
    for (int k = 0; k < size_; ++k) start_[k].of[lane] = step.y(k), rates_[k].of[lane] = step.f(k);
  }
}

// Compute the missing rates at the starts of steps.
void Lanes::compute_unknown_starts(const Attempts& attempts) {
  const auto is_unknown = [&](int lane) { return methods_[lane] && !attempts[lane].rate_is_known; };
  int unknown = 0;
  for (int lane = 0; lane < width; ++lane) unknown += is_unknown(lane);
  if (!unknown) return;
  std::copy(start_.begin(), start_.end(), y_.begin());
  evaluate(0.0, 0);
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane]) continue;
    Step& step = methods_[lane]->step_;
    if (is_unknown(lane)) {
      for (int k = 0; k < size_; ++k) step.f(k) = rates_[k].of[lane];
      methods_[lane]->start_is_computed_ = true;
    } else {
      for (int k = 0; k < size_; ++k) rates_[k].of[lane] = step.f(k);
    }
  }
}

template <class Coefficients>
void Lanes::combine(const Lines& start, const Coefficients& coefficients, int count, const Members& factor,
                    Lines& sum) {
  constexpr int max_stages = 16;
  const Members* rates[max_stages];
  double used_coefficients[max_stages];
  int used = 0;
  for (int i = 0; i < count; ++i)
    if (coefficients(i) != 0.0) used_coefficients[used] = coefficients(i), rates[used++] = &rates_[i * size_];
  add_products(start.data(), rates, used_coefficients, factor, used, size_, sum.data());
}

void Lanes::evaluate(double stage_time, int stage) {
  Members *rate = &rates_[stage * size_], sound, not_finite;
  compute_cosines_and_sines_of_vectors(y_[0].of, n_ * width, trig_[0].of, trig_[n_].of);
  if (has_force_) apply_forces(stage_time);
  std::copy_n(&y_[n_], n_, rate);
  terms_->accelerations(y_.data(), trig_.data(), &y_[n_], force_.data(), correction_.data(), constants_.data(),
                        rate + n_, &sound);
  find_not_finite(rate, size_, not_finite);
  for (int lane = 0; lane < width; ++lane)
    if (!(sound.of[lane] > 0.0) || not_finite.of[lane] != 0.0) methods_[lane] = nullptr;
}

void Lanes::apply_forces(double stage_time) {
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane]) continue;
    for (int k = 0; k < n_; ++k) q_tree_(k) = y_[k].of[lane], v_(k) = y_[n_ + k].of[lane];
    if (!methods_[lane]->system_.force_of_rate(t_[lane] + stage_time * h_.of[lane], q_tree_, v_, applied_))
      methods_[lane] = nullptr;
    for (int k = 0; k < n_; ++k) force_[k].of[lane] = applied_(k);
  }
}

}  // namespace ckc
