#include "motion/lanes.hpp"

#include <algorithm>
#include <cmath>

#include "tree/widest_registers.hpp"

namespace ckc {

// With fewer members, computing each alone takes less time.
constexpr int min_members = 3;

namespace {

constexpr int width = Lanes::width;
using Members = CompiledTerms::Members;

// sum = start + factors[0] * rates[0] + ... of vectors of `size` numbers
WITH_WIDEST_REGISTERS void add_products(const Members* start, const Members* const* rates, const Members* factors,
                                        int count, int size, Members* sum) {
  for (int k = 0; k < size; ++k) {
    Members x = start[k];
    for (int i = 0; i < count; ++i)
      for (int lane = 0; lane < width; ++lane) x.of[lane] += factors[i].of[lane] * rates[i][k].of[lane];
    sum[k] = x;
  }
}

}  // namespace

void Lanes::set_constants(int lane, const Vector& constants) {
  if (constants_.size() != static_cast<size_t>(constants.size())) {
    constants_.resize(static_cast<size_t>(constants.size()));
    for (size_t k = 0; k < constants_.size(); ++k) std::fill_n(constants_[k].of, width, constants(k));
  }
  for (size_t k = 0; k < constants_.size(); ++k) constants_[k].of[lane] = constants(k);
}

void Lanes::compute(const std::array<Attempt, width>& attempts) {
  for (Explicit::Kind kind : {Explicit::dop853, Explicit::rk45}) compute(attempts, kind);
}

void Lanes::compute(const std::array<Attempt, width>& attempts, Explicit::Kind kind) {
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
      for (Members& x : start_) x.of[lane] = x.of[first];
      for (int k = 0; k < size_; ++k) rates_[k].of[lane] = rates_[k].of[first];
      h_.of[lane] = h_.of[first], t_[lane] = t_[first];
    }
  for (int s = 1; s < stages; ++s) combine(method.A_.row(s), s), evaluate(method.C_(s), s);
  combine(method.B_, stages);
  evaluate(1.0, stages);
  for (int lane = 0; lane < width; ++lane) {
    if (!methods_[lane]) continue;
    Explicit& of_lane = *methods_[lane];
    Step& step = of_lane.step_;
    for (int s = 0; s <= stages; ++s)
      for (int k = 0; k < size_; ++k) of_lane.K_(k, s) = rates_[s * size_ + k].of[lane];
    for (int k = 0; k < size_; ++k) step.y_new(k) = y_[k].of[lane];
    step.f_new = of_lane.K_.col(stages);
    if (!step.y_new.allFinite() || !of_lane.K_.leftCols(stages + 1).allFinite()) continue;
    of_lane.computed_t_ = t_[lane], of_lane.computed_h_ = h_.of[lane];
  }
}

void Lanes::start(const std::array<Attempt, width>& attempts, const Explicit& first) {
  terms_ = first.system_.terms_of_rate();
  n_ = first.system_.core.n, size_ = first.system_.size;
  start_.resize(size_), y_.resize(size_), rates_.resize(size_ * (first.stages_ + 1)), factors_.resize(first.stages_);
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
    for (int k = 0; k < size_; ++k) start_[k].of[lane] = step.y(k), rates_[k].of[lane] = step.f(k);
  }
}

template <class Coefficients>
void Lanes::combine(const Coefficients& coefficients, int count) {
  constexpr int max_stages = 16;
  const Members* rates[max_stages];
  int used = 0;
  for (int i = 0; i < count; ++i) {
    if (coefficients(i) == 0.0) continue;
    for (int lane = 0; lane < width; ++lane) factors_[used].of[lane] = h_.of[lane] * coefficients(i);
    rates[used++] = &rates_[i * size_];
  }
  add_products(start_.data(), rates, factors_.data(), used, size_, y_.data());
}

void Lanes::evaluate(double stage_time, int stage) {
  Members *rate = &rates_[stage * size_], sound;
  compute_cosines_and_sines(y_[0].of, n_ * width, trig_[0].of, trig_[n_].of);
  if (has_force_) apply_forces(stage_time);
  std::copy_n(&y_[n_], n_, rate);
  terms_->accelerations(y_.data(), trig_.data(), &y_[n_], force_.data(), correction_.data(), constants_.data(),
                        rate + n_, &sound);
  for (int lane = 0; lane < width; ++lane)
    if (!(sound.of[lane] > 0.0)) methods_[lane] = nullptr;
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
