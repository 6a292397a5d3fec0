#include "control/sensor.hpp"

#include <cmath>

namespace ckc {

constexpr int max_newton_steps = 12;
constexpr double max_newton_step = 0.5;    // rad, or relative to the mechanism's size; longer steps are not local
constexpr double newton_tolerance = 1e-9;  // rad, or relative to the mechanism's size

// SplitMix64 of Steele, Lea and Flood, upper 53 bits.
double Noise::uniform() {
  std::uint64_t z = (state_ += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return (static_cast<double>((z ^ (z >> 31)) >> 11) + 0.5) * 0x1p-53;
}

// Natural logarithm by its series in (m - 1) / (m + 1), with m between sqrt(1/2) and sqrt(2).
static double portable_log(double x) {
  int exponent;
  double m = std::frexp(x, &exponent);
  if (m < 0.70710678118654752) m *= 2, --exponent;
  const double r = (m - 1) / (m + 1), square = r * r;
  double sum = 0.0;
  for (int k = 23; k > 0; k -= 2) sum = sum * square + 1.0 / k;
  return exponent * 0.69314718055994531 + 2 * r * sum;
}

// Marsaglia's polar method, using the first number of each pair.
double Noise::normal() {
  for (;;) {
    const double x = 2 * uniform() - 1, y = 2 * uniform() - 1, s = x * x + y * y;
    if (s < 1 && s > 0) return x * std::sqrt(-2 * portable_log(s) / s);
  }
}

void Sensor::reset() {
  noise_.reset(seed);
  has_measured_ = false;
  for (Vector* x : {&q, &q_dot, &previous_q_}) x->setZero(resolution.size());
  if (observer) v_tree.setZero(observer->n), q_tree_.setZero(observer->tree.nq), step_.setZero(observer->n);
}

void Sensor::measure(In q_true, In q_dot_true, double period) {
  const auto d = resolution.size();
  previous_q_ = q;
  for (Eigen::Index k = 0; k < d; ++k) {
    q(k) = q_true(k) + q_noise(k) * noise_.normal();
    if (resolution(k) > 0) q(k) = resolution(k) * std::floor(q(k) / resolution(k) + 0.5);
  }
  for (Eigen::Index k = 0; k < d; ++k) {
    double rate = q_dot_true(k) + q_dot_noise(k) * noise_.normal();
    if (differentiates) rate = has_measured_ ? (q(k) - previous_q_(k)) / period : 0.0;
    q_dot(k) = has_measured_ ? q_dot(k) + smoothing * (rate - q_dot(k)) : rate;
  }
  has_measured_ = true;
}

bool Sensor::project_observer(In q_tree) {
  Core& core = *observer;
  q_tree_ = q_tree;
  for (int k = 0; k < core.d; ++k) q_tree_(core.tree.q_index[core.q[k]]) = q(k);
  double size = core.rank ? max_newton_step : 0.0;
  for (int step = 0; step <= max_newton_steps; ++step) {
    core.set_configuration(q_tree_);
    core.factorize_phi_z();
    if (size <= newton_tolerance) break;
    if (core.phi_z.singular() || step == max_newton_steps) return false;
    core.closure_step_in_z(core.constraints.phi, step_);
    size = step_.size() ? step_.cwiseQuotient(core.scales.columns).lpNorm<Eigen::Infinity>() : 0.0;
    if (!(size <= max_newton_step)) return false;
    core.tree.integrate(q_tree_, step_);
  }
  core.compute_rho();
  core.multiply_rho(q_dot, v_tree);
  core.set_velocity(v_tree);
  return true;
}

void TorqueDrive::limit_and_quantize(Out tau, double period) {
  for (Eigen::Index k = 0; k < tau.size(); ++k) {
    const double max_change = rate(k) * period;
    output(k) += std::min(std::max(tau(k) - output(k), -max_change), max_change);
    tau(k) = resolution(k) > 0 ? resolution(k) * std::floor(output(k) / resolution(k) + 0.5) : output(k);
  }
}

}  // namespace ckc
