#include "control/sensor.hpp"

#include <cmath>

namespace ckc {

constexpr int most_steps = 12;
constexpr double longest = 0.5, negligible = 1e-9;  // rad, or of the mechanism's size: Newton's steps, first and last

// Steele, Lea & Flood's SplitMix64, its upper 53 bits.
double Noise::uniform() {
  std::uint64_t z = (state_ += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return (static_cast<double>((z ^ (z >> 31)) >> 11) + 0.5) * 0x1p-53;
}

// The natural logarithm by its series in (m - 1) / (m + 1), m between sqrt(1/2) and sqrt(2).
static double logarithm(double x) {
  int exponent;
  double m = std::frexp(x, &exponent);
  if (m < 0.70710678118654752) m *= 2, --exponent;
  const double r = (m - 1) / (m + 1), square = r * r;
  double sum = 0.0;
  for (int k = 23; k > 0; k -= 2) sum = sum * square + 1.0 / k;
  return exponent * 0.69314718055994531 + 2 * r * sum;
}

// Marsaglia's polar method; of each pair the first.
double Noise::normal() {
  for (;;) {
    const double x = 2 * uniform() - 1, y = 2 * uniform() - 1, s = x * x + y * y;
    if (s < 1 && s > 0) return x * std::sqrt(-2 * logarithm(s) / s);
  }
}

void Sensor::begin() {
  noise_.begin(seed);
  begun_ = false;
  for (Vector* x : {&q, &q_dot, &before_}) x->setZero(resolution.size());
  if (observer) v_tree.setZero(observer->n), q_tree_.setZero(observer->tree.nq), step_.setZero(observer->n);
}

void Sensor::look(In q_true, In q_dot_true, double period) {
  const auto d = resolution.size();
  before_ = q;
  for (Eigen::Index k = 0; k < d; ++k) {
    q(k) = q_true(k) + q_noise(k) * noise_.normal();
    if (resolution(k) > 0) q(k) = resolution(k) * std::floor(q(k) / resolution(k) + 0.5);
  }
  for (Eigen::Index k = 0; k < d; ++k) {
    double rate = q_dot_true(k) + q_dot_noise(k) * noise_.normal();
    if (differences) rate = begun_ ? (q(k) - before_(k)) / period : 0.0;
    q_dot(k) = begun_ ? q_dot(k) + smoothing * (rate - q_dot(k)) : rate;
  }
  begun_ = true;
}

bool Sensor::close(In q_tree) {
  Core& core = *observer;
  q_tree_ = q_tree;
  for (int k = 0; k < core.d; ++k) q_tree_(core.tree.place[core.q[k]]) = q(k);
  double size = core.rank ? longest : 0.0;
  for (int step = 0; step <= most_steps; ++step) {
    core.set(q_tree_);
    core.factor();
    if (size <= negligible) break;
    if (core.phi_z.singular() || step == most_steps) return false;
    core.z_step(core.rows.phi, step_);
    size = step_.size() ? step_.cwiseQuotient(core.scales.columns).lpNorm<Eigen::Infinity>() : 0.0;
    if (!(size <= longest)) return false;
    core.tree.integrate(q_tree_, step_);
  }
  core.reduce();
  core.velocity(q_dot, v_tree);
  core.set_velocity(v_tree);
  return true;
}

void Drive::limit(Out tau, double period) {
  for (Eigen::Index k = 0; k < tau.size(); ++k) {
    const double most = rate(k) * period;
    sent(k) += std::min(std::max(tau(k) - sent(k), -most), most);
    tau(k) = resolution(k) > 0 ? resolution(k) * std::floor(sent(k) / resolution(k) + 0.5) : sent(k);
  }
}

}  // namespace ckc
