// Bindings of the sensitivities.
#include <iterator>

#include "bind/run.hpp"
#include "sensitivity/sensitivity_system.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr const char* kind_names[] = {
    "placement",     "inertia",  "gravity",  "stiffness",   "rest_length", "damping", "joint_stiffness", "joint_rest",
    "joint_damping", "constant", "friction", "restitution", "lower",       "upper",   "armature",        "length",
    "offset",        "ratio",    "gain_q",   "gain_q_dot",  "target",      "gear",    "torque_limit"};

ParameterDerivative derivative_from_row(const nb::tuple& row) {
  const auto name = nb::cast<std::string>(row[0]);
  const auto* result = std::find(std::begin(kind_names), std::end(kind_names), name);
  require(result != std::end(kind_names), "effect: no " + name);
  return {static_cast<ParameterDerivative::Kind>(result - std::begin(kind_names)), nb::cast<int>(row[1]),
          nb::cast<Vector>(row[2])};
}

SensitivityParameter parameter_from_row(const nb::tuple& row) {
  SensitivityParameter result{{}, nb::cast<Vector>(row[1]), nb::cast<Vector>(row[2]), nb::cast<int>(row[3])};
  for (const auto& effect : nb::cast<nb::list>(row[0]))
    result.derivatives.push_back(derivative_from_row(nb::cast<nb::tuple>(effect)));
  return result;
}

SensitivityResults& sensitivities_of(Loop& loop) {
  require(loop.sensitivities, "loop: it was built without sensitivities");
  return *loop.sensitivities;
}

// Return the sensitivities of (q', v') at the present state, one column per parameter.
Matrix state_sensitivities(Loop& loop) { return sensitivities_of(loop).state_sensitivities(loop.step_loop->y()); }

// Return the derivative of the time of the present event with respect to each parameter, where a coordinate or its
// rate crosses a value; None if it is at rest. A rate that an impact has just moved across its value has the time of
// the impact.
nb::object time_shifts(Loop& loop, int coordinate, bool of_rate) {
  StepLoop& step_loop = *loop.step_loop;
  SensitivityResults& system = sensitivities_of(loop);
  require_indices({coordinate}, loop.core->n, "coordinate");
  if (of_rate && system.impact_at == step_loop.t()) return nb::cast(system.sensitivities().time_shift(coordinate));
  Vector a(loop.core->n);
  if (!step_loop.sync_core() || !step_loop.system->acceleration(step_loop.t(), a)) return nb::none();
  const Vector result = system.sensitivities().time_shift({coordinate, of_rate}, step_loop.system->velocity, a,
                                                          system.state_sensitivities(step_loop.y()));
  return result.allFinite() ? nb::cast(result) : nb::none();
}

// Return why the motion is not differentiable from here on, or None.
nb::object non_differentiable_event(Loop& loop) {
  const auto& event = sensitivities_of(loop).non_differentiable_event;
  if (!event) return nb::none();
  static constexpr const char* reason_names[] = {"time", "restitution", "let_go"};
  return nb::make_tuple(event->arrival.coordinate, event->arrival.of_rate, event->parameter,
                        reason_names[event->reason]);
}

// Return velocity and acceleration of the tree at the present state, (2 n).
nb::object velocity_and_acceleration(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  const int n = loop.core->n;
  Vector a(n), whole(2 * n);
  if (!step_loop.sync_core() || !step_loop.system->acceleration(step_loop.t(), a)) return nb::none();
  whole << step_loop.system->velocity, a;
  return nb::cast(whole);
}

}  // namespace

SensitivityTable sensitivity_table(const nb::dict& table) {
  SensitivityTable result{model_from_table(table),
                          get<Indices>(table, "place"),
                          get<Indices>(table, "real_q"),
                          get<Indices>(table, "real_v"),
                          closure_from_table(nb::cast<nb::dict>(table["closure"])),
                          springs_from_table(nb::cast<nb::dict>(table["springs"])),
                          get<Indices>(table, "own"),
                          get<bool>(table, "at_equilibrium"),
                          get<Vector>(table, "target"),
                          get<Matrix>(table, "turns"),
                          get<Indices>(table, "part"),
                          {},
                          get<Matrix>(table, "directions")};
  for (const auto& row : nb::cast<nb::list>(table["parameters"]))
    result.parameters.push_back(parameter_from_row(nb::cast<nb::tuple>(row)));
  return result;
}

void bind_sensitivities(nb::class_<Loop>& binding) {
  binding.def("changes", &state_sensitivities)
      .def("delays", &time_shifts, "coordinate"_a, "of_rate"_a)
      .def("motion", &velocity_and_acceleration)
      .def("rates_found",  // by compiled terms and by Pinocchio's
           [](Loop& loop) {
             return nb::make_tuple(sensitivities_of(loop).sensitivities().compiled_evaluations,
                                   sensitivities_of(loop).sensitivities().general_evaluations);
           })
      .def("apart", &non_differentiable_event)
      .def("asked", [](const Loop& loop) { return loop.view->term_requested; });  // whether a callback has used a term
}

}  // namespace ckc
