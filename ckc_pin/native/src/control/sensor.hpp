// Sensors and torque drives of a digital controller.
#pragma once

#include <cstdint>
#include <memory>

#include "loops/core.hpp"

namespace ckc {

// Normal random numbers that are identical on every machine. The only function of the C library that they use is sqrt,
// which IEEE 754 defines exactly.
class Noise {
 public:
  void reset(std::uint64_t seed) { state_ = seed; }
  double normal();

 private:
  double uniform();  // in (0, 1)
  std::uint64_t state_ = 0;
};

// Encoders with resolution and noise, evaluated at the samples. Rates are measured or differentiated numerically, then
// filtered.
class Sensor {
 public:
  Vector resolution, q_noise, q_dot_noise;  // (d); 0 where there is none
  bool differentiates = false;
  double smoothing = 1.0;  // weight of a new rate in the filter
  std::uint64_t seed = 0;
  std::unique_ptr<Core> observer;  // mechanism at the measured configuration

  void reset();
  // Set `q` and `q_dot` to measured values.
  void measure(In q_true, In q_dot_true, double period);
  // Project the observer onto the constraint manifold at the measured q, starting from q_tree. False if that fails.
  bool project_observer(In q_tree);
  Vector q, q_dot, v_tree;

 private:
  Noise noise_;
  bool has_measured_ = false;
  Vector previous_q_, q_tree_, step_;
};

// Torque outputs with limited resolution and rate.
struct TorqueDrive {
  Vector resolution, rate;  // by motor, N m and N m/s; 0 and infinite where there is none
  Vector output;            // before quantization
  void limit_and_quantize(Out tau, double period);
};

}  // namespace ckc
