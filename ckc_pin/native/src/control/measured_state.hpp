// What controllers and forces are evaluated at, and why they have no value.
#pragma once

#include <string>

#include "loops/core.hpp"

namespace ckc {

// The state that a controller sees: the core at that state with its terms, and q and q_dot of the user's partition.
struct MeasuredState {
  double t;
  Core& core;
  const Vector &q, &q_dot;
  const Vector& v_tree;  // velocity at which C is evaluated
  const Vector& rate;    // q_dot of the core's partition
};

// Why a controller has no u, or a force no value.
struct ControlFailure {
  std::string message;
  Vector u;             // the controller's output, if it is not finite
  bool raised = false;  // the callback raised an exception, which the bindings have stored
};

}  // namespace ckc
