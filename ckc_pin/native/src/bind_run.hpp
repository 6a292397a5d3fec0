// A loop with what its callers' functions need.
#pragma once

#include "bind_control.hpp"
#include "level_set.hpp"
#include "loop.hpp"
#include "variation.hpp"

namespace ckc {

struct Run {
  std::shared_ptr<View> view = std::make_shared<View>();
  std::unique_ptr<Core> core;
  std::unique_ptr<Loop> loop;
  nb::object rows;
  Places places;
};

void bind_parts(nb::module_& m, nb::class_<Run>& loop);
void bind_variation(nb::class_<Run>& loop);
VariationTable variation_of(const nb::dict& table);

}  // namespace ckc
