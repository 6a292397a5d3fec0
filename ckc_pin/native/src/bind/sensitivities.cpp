// How a motion changes with parameters, from Python's tables.
#include <iterator>

#include "bind/run.hpp"
#include "sensitivity/sensitivity_system.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr const char* kinds[] = {
    "placement",   "inertia",    "gravity",       "stiffness", "rest_length", "damping",     "joint_stiffness",
    "joint_rest",  "joint_damping", "constant",   "friction",  "restitution", "lower",       "upper",
    "armature",    "length",     "offset",        "ratio",     "gain_q",      "gain_q_dot",  "target", "gear",
    "torque_limit"};

Effect effect_of(const nb::tuple& row) {
  const auto name = nb::cast<std::string>(row[0]);
  const auto* found = std::find(std::begin(kinds), std::end(kinds), name);
  require(found != std::end(kinds), "effect: no " + name);
  return {static_cast<Effect::Kind>(found - std::begin(kinds)), nb::cast<int>(row[1]), nb::cast<Vector>(row[2])};
}

Parameter parameter_of(const nb::tuple& row) {
  Parameter found{{}, nb::cast<Vector>(row[1]), nb::cast<Vector>(row[2]), nb::cast<int>(row[3])};
  for (const auto& effect : nb::cast<nb::list>(row[0])) found.effects.push_back(effect_of(nb::cast<nb::tuple>(effect)));
  return found;
}

WithVariation& varied(Run& run) {
  auto* found = dynamic_cast<WithVariation*>(run.loop->system.get());
  require(found, "a loop with parameters is needed");
  return *found;
}

// The changes of (q', v') at the present state, a column a parameter.
Matrix changes(Run& run) { return varied(run).changes(run.loop->y()); }

// How much later with each parameter a coordinate, or its rate, comes to where it is now; none where it rests. A rate that
// an impact has taken over its value just now comes there when that does.
nb::object delays(Run& run, int coordinate, bool of_rate) {
  Loop& loop = *run.loop;
  WithVariation& system = varied(run);
  require_indices({coordinate}, run.core->n, "coordinate");
  if (of_rate && system.impact_at == loop.t()) return nb::cast(system.variation().delay(coordinate));
  Vector a(run.core->n);
  if (!loop.settle_core() || !loop.system->acceleration(loop.t(), a)) return nb::none();
  const Vector found = system.variation().delay({coordinate, of_rate}, loop.system->velocity, a, system.changes(loop.y()));
  return found.allFinite() ? nb::cast(found) : nb::none();
}

// Why the motion has no derivative from here on: (coordinate, whether it is at rest there, parameter, reason); else none.
nb::object apart(Run& run) {
  const auto& found = varied(run).apart;
  if (!found) return nb::none();
  static constexpr const char* reasons[] = {"time", "restitution", "let_go"};
  return nb::make_tuple(found->met.coordinate, found->met.of_rate, found->parameter, reasons[found->reason]);
}

// The same states' velocity and acceleration of the tree, (2 n).
nb::object motion(Run& run) {
  Loop& loop = *run.loop;
  const int n = run.core->n;
  Vector a(n), whole(2 * n);
  if (!loop.settle_core() || !loop.system->acceleration(loop.t(), a)) return nb::none();
  whole << loop.system->velocity, a;
  return nb::cast(whole);
}

}  // namespace

VariationTable variation_of(const nb::dict& table) {
  VariationTable found{model_of(table),
                       get<Indices>(table, "place"),
                       get<Indices>(table, "real_q"),
                       get<Indices>(table, "real_v"),
                       closure_of(nb::cast<nb::dict>(table["closure"])),
                       springs_of(nb::cast<nb::dict>(table["springs"])),
                       get<Indices>(table, "own"),
                       get<bool>(table, "at_equilibrium"),
                       get<Vector>(table, "target"),
                       get<Matrix>(table, "turns"),
                       get<Indices>(table, "part"),
                       {},
                       get<Matrix>(table, "directions")};
  for (const auto& row : nb::cast<nb::list>(table["parameters"]))
    found.parameters.push_back(parameter_of(nb::cast<nb::tuple>(row)));
  return found;
}

void bind_variation(nb::class_<Run>& loop) {
  loop.def("changes", &changes)
      .def("delays", &delays, "coordinate"_a, "of_rate"_a)
      .def("motion", &motion)
      .def("rates_found",  // by the code that is written out, and by the tree
           [](Run& run) { return nb::make_tuple(varied(run).variation().written, varied(run).variation().general); })
      .def("apart", &apart)
      .def("asked", [](const Run& run) { return run.view->asked; });  // whether a caller's function looked at terms
}

}  // namespace ckc
