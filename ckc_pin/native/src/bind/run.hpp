// A loop with what its callers' functions need.
#pragma once

#include "bind/control.hpp"
#include "motion/level_set.hpp"
#include "motion/loop.hpp"
#include "sensitivity/sensitivities.hpp"

namespace ckc {

struct Run {
  std::shared_ptr<View> view = std::make_shared<View>();
  std::unique_ptr<Core> core;
  std::unique_ptr<Loop> loop;
  nb::object rows;
  Places places;
  long rhs_before = 0;  // right-hand sides before the core was given terms that are written out
};

// Make its loop, from Python's tables.
void prepare(Run& run, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
             const nb::dict& solver, const nb::list& events);

extern const char* const reasons[];  // why a loop stopped, as Python has it

void bind_parts(nb::module_& m, nb::class_<Run>& loop);
void bind_variation(nb::class_<Run>& loop);
VariationTable variation_of(const nb::dict& table);

}  // namespace ckc
