// Python's `Loop`: the step loop with its core and callbacks, and the values that it returns.
#pragma once

#include "bind/control.hpp"
#include "motion/dae.hpp"
#include "motion/level_set.hpp"
#include "motion/loop.hpp"
#include "sensitivity/sensitivity_integrand.hpp"

namespace ckc {

struct Loop {
  std::shared_ptr<View> view = std::make_shared<View>();
  std::unique_ptr<Core> core;
  std::unique_ptr<StepLoop> step_loop;
  SensitivityIntegrand* sensitivities = nullptr;  // the step loop's integrand; null without sensitivities
  nb::object rows;                                // the array of the record, kept alive
  PartitionLists partition_lists;
  long rhs_before_compiled = 0;  // right-hand sides before compiled terms were used
};

// An event as Python describes it. `function`: of a user's event, else None.
struct EventTable {
  Event event;
  nb::object function;
};

// Why no step could be made.
struct StepFailure {
  RhsFailure reason;
  std::string message;  // of the controller
  Vector u;             // of the controller, if it is not finite
  double sigma_min;     // smallest singular value of phi_z; NaN if unknown
  double margin;        // sigma_min over |J|
  Vector q_tree;
  Indices q, z;
};

// A joint that sticks or is at a stop, with its holding force and the bounds of the force.
struct LockedJoint {
  int coordinate;
  double force, lower, upper;
};

// Counters of a run.
struct LoopStats {
  std::string terms;   // "pinocchio" or "generated"
  std::string method;  // of the last step
  long rhs, steps, rejected, newton, factorizations, jacobians, differences, switches, python_calls;
  nb::typed<nb::dict, nb::str, int> steps_by_method, rhs_by_terms;
};

// Build the loop from Python's tables.
void prepare(Loop& loop, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
             const nb::dict& solver, const nb::list& events);

void bind_types(nb::module_& m);
void bind_parts(nb::module_& m, nb::class_<Loop>& binding);
void bind_sensitivities(nb::class_<Loop>& binding);
SensitivityTable sensitivity_table(const nb::dict& table);

}  // namespace ckc
