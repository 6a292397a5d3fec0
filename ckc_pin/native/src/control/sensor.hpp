// What a computer sees of a state, and what its drives make of the torques it asks for.
#pragma once

#include <cstdint>
#include <memory>

#include "loops/core.hpp"

namespace ckc {

// Normal numbers that are the same on every machine: no function of the C library but the square root, which IEEE 754 fixes.
class Noise {
 public:
  void begin(std::uint64_t seed) { state_ = seed; }
  double normal();

 private:
  double uniform();  // in (0, 1)
  std::uint64_t state_ = 0;
};

// Encoders with steps and noise, rates measured or by differences, filtered; at the clock's instants alone.
class Sensor {
 public:
  Vector resolution, q_noise, q_dot_noise;  // (d); 0 where there is none
  bool differences = false;
  double smoothing = 1.0;  // of a new rate in the filtered one
  std::uint64_t seed = 0;
  std::unique_ptr<Core> observer;  // closed at what is measured

  void begin();
  // Look at q and q_dot, which then are what is measured.
  void look(In q_true, In q_dot_true, double period);
  // Close the observer's loops at that, from a configuration near; false where they do not close.
  bool close(In q_tree);
  Vector q, q_dot, v_tree;

 private:
  Noise noise_;
  bool begun_ = false;
  Vector before_, q_tree_, step_;
};

// Quantised torques that cannot jump.
struct Drive {
  Vector resolution, rate;  // by motor, N m and N m/s; 0 and infinite where there is none
  Vector sent;              // before it is quantised
  void limit(Out tau, double period);
};

}  // namespace ckc
