// Bindings of the sensitivities.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include "bind/run.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

// (kind, index, numbers)
ParameterDerivative derivative_from_row(const nb::tuple& row) {
  return {nb::cast<ParameterDerivative::Kind>(row[0]), nb::cast<int>(row[1]), nb::cast<Vector>(row[2])};
}

// (derivatives, q, q_dot, assembled_at)
SensitivityParameter parameter_from_row(const nb::tuple& row) {
  SensitivityParameter result{{}, nb::cast<Vector>(row[1]), nb::cast<Vector>(row[2]), nb::cast<int>(row[3])};
  for (const auto& derivative : nb::cast<nb::list>(row[0]))
    result.derivatives.push_back(derivative_from_row(nb::cast<nb::tuple>(derivative)));
  return result;
}

SensitivityIntegrand& sensitivities_of(Loop& loop) {
  require(loop.sensitivities, "loop: it was built without sensitivities");
  return *loop.sensitivities;
}

// Return the sensitivities of (q', v') at the present state, one column per parameter.
Matrix state_sensitivities(Loop& loop) { return sensitivities_of(loop).state_sensitivities(loop.step_loop->y()); }

// Return the derivative of the time of the present event with respect to each parameter, where a coordinate or its
// rate crosses a value; None if it is at rest. A rate that an impact has just moved across its value has the time of
// the impact.
std::optional<Vector> time_shifts(Loop& loop, int coordinate, bool of_rate) {
  StepLoop& step_loop = *loop.step_loop;
  const SensitivityIntegrand& integrand = sensitivities_of(loop);
  require_indices({coordinate}, loop.core->n, "coordinate");
  if (of_rate && integrand.impact_at == step_loop.t()) return integrand.sensitivities.time_shift(coordinate);
  Vector a(loop.core->n);
  if (!step_loop.sync_core() || !step_loop.system->acceleration(step_loop.t(), a)) return {};
  const Vector result = integrand.time_shift({coordinate, of_rate}, step_loop.y(), a);
  return result.allFinite() ? std::optional(result) : std::nullopt;
}

// Return velocity and acceleration of the tree at the present state, (2 n).
std::optional<Vector> velocity_and_acceleration(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  const int n = loop.core->n;
  Vector a(n), rates(2 * n);
  if (!step_loop.sync_core() || !step_loop.system->acceleration(step_loop.t(), a)) return {};
  rates << step_loop.system->velocity, a;
  return rates;
}

}  // namespace

SensitivityTable sensitivity_table(const nb::dict& table) {
  SensitivityTable result{model_from_table(table),
                          get<Indices>(table, "q_index"),
                          get<Indices>(table, "real_q"),
                          get<Indices>(table, "real_v"),
                          closure_from_table(nb::cast<nb::dict>(table["closure"])),
                          springs_from_table(nb::cast<nb::dict>(table["springs"])),
                          get<Indices>(table, "fixed_q"),
                          get<bool>(table, "at_equilibrium"),
                          get<Vector>(table, "target"),
                          get<Matrix>(table, "transmission"),
                          get<Indices>(table, "part"),
                          {},
                          get<Matrix>(table, "directions")};
  for (const auto& row : nb::cast<nb::list>(table["parameters"]))
    result.parameters.push_back(parameter_from_row(nb::cast<nb::tuple>(row)));
  return result;
}

void bind_sensitivities(nb::class_<Loop>& binding) {
  binding
      .def("state_sensitivities", &state_sensitivities,
           "Return the sensitivities of (q', v'), one column per parameter.")
      .def("time_shifts", &time_shifts, "coordinate"_a, nb::kw_only(), "of_rate"_a,
           "Return the derivative of the present event's time with respect to each parameter; None at rest.")
      .def("velocity_and_acceleration", &velocity_and_acceleration, "Return both for the tree, (2 n).")
      .def(
          "rate_evaluations",
          [](Loop& loop) {
            const Sensitivities& sensitivities = sensitivities_of(loop).sensitivities;
            return std::pair(sensitivities.compiled_evaluations, sensitivities.general_evaluations);
          },
          "Return how often the rates of sensitivities were computed: by compiled terms, by Pinocchio's.")
      .def(
          "non_differentiable_event", [](Loop& loop) { return sensitivities_of(loop).non_differentiable_event; },
          "Return why the motion is not differentiable from here on.")
      .def_prop_ro(
          "term_requested", [](const Loop& loop) { return loop.view->term_requested; },
          "whether a callback has used a term");
}

}  // namespace ckc
