#include "motion/method.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace ckc {

double Method::min_step_size(double t_bound) const {
  constexpr double infinity = std::numeric_limits<double>::infinity(), eps = std::numeric_limits<double>::epsilon();
  return std::max(10 * (std::nextafter(step_.t, infinity) - step_.t), 0.1 * eps * (t_bound - step_.t));
}

bool Method::evaluate_start() {
  if (std::exchange(start_is_computed_, false) ? !count_computed_rhs() : !evaluate(step_.t, step_.y, step_.f))
    return false;
  const int size = system_.full_motion_size();
  for (Vector* x : {&step_.x, &step_.x_dot, &step_.x_new, &step_.x_dot_new}) x->resize(size);
  if (size) system_.full_motion(step_.f, step_.x, step_.x_dot);
  return true;
}

double Method::disagreement(In integral) {
  x_scale_ = tolerance_.scale(step_.x, step_.x_new);
  system_.add_rounding(step_.x_new, x_scale_);
  x_error_ = step_.x_new - step_.x - integral;
  return norm(x_error_, x_scale_);
}

bool Method::return_to_start() { return system_.return_to_accepted() && evaluate_start(); }

// E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, section II.4.
double Method::initial_step_size(double t_bound, int order) {
  const double duration = std::min({t_bound - step_.t, tolerance_.max_step, system_.boundary_layer_time()});
  const Vector scale = tolerance_.scale(step_.y, step_.y);
  const double d0 = norm(step_.y, scale), d1 = norm(step_.f, scale);
  double h0 = std::min(d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1, duration);
  Vector f1(step_.f.size());
  while (!evaluate(step_.t + h0, step_.y + h0 * step_.f, f1)) {
    h0 *= 0.1;
    if (must_stop() || h0 < min_step_size(t_bound)) return h0;
  }
  const double d2 = norm(f1 - step_.f, scale) / h0;
  const double h1 =
      d1 <= 1e-15 && d2 <= 1e-15 ? std::max(1e-6, h0 * 1e-3) : std::pow(0.01 / std::max(d1, d2), 1.0 / (order + 1));
  return std::min({100 * h0, h1, duration});
}

}  // namespace ckc
