// The loop that Python sees: the step loop with its core and callbacks.
#pragma once

#include "bind/control.hpp"
#include "motion/level_set.hpp"
#include "motion/loop.hpp"
#include "sensitivity/sensitivity_system.hpp"

namespace ckc {

struct Loop {
  std::shared_ptr<View> view = std::make_shared<View>();
  std::unique_ptr<Core> core;
  std::unique_ptr<StepLoop> step_loop;
  SensitivityResults* sensitivities = nullptr;  // of the step loop's system; null without sensitivities
  nb::object rows;
  PartitionLists partition_lists;
  long rhs_before_compiled = 0;  // right-hand sides before compiled terms were used
};

// Build the loop from Python's tables.
void prepare(Loop& loop, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
             const nb::dict& solver, const nb::list& events);

extern const char* const stop_reasons[];  // why a loop stopped, as Python has it

void bind_parts(nb::module_& m, nb::class_<Loop>& binding);
void bind_sensitivities(nb::class_<Loop>& binding);
SensitivityTable sensitivity_table(const nb::dict& table);

}  // namespace ckc
