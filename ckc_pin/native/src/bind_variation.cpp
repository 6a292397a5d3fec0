// How a motion changes with parameters, from Python's tables.
#include <iterator>

#include "bind_run.hpp"
#include "varied.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr const char* kinds[] = {"start",       "placement",     "inertia",  "gravity",  "stiffness", "rest_length",
                                 "damping",     "joint_stiffness", "joint_rest", "joint_damping", "constant", "friction",
                                 "restitution", "lower",         "upper",    "length",   "offset",    "gain_q",
                                 "gain_q_dot"};

Parameter parameter_of(const nb::tuple& row) {
  const auto name = nb::cast<std::string>(row[0]);
  const auto* found = std::find(std::begin(kinds), std::end(kinds), name);
  require(found != std::end(kinds), "parameter: no " + name);
  return {static_cast<Parameter::Kind>(found - std::begin(kinds)), nb::cast<int>(row[1]), nb::cast<Vector>(row[2]),
          nb::cast<Vector>(row[3]), nb::cast<Vector>(row[4])};
}

WithVariation& varied(Run& run) {
  auto* found = dynamic_cast<WithVariation*>(run.loop->system.get());
  require(found, "a loop with parameters is needed");
  return *found;
}

// The changes of (q', v') at the present state, a column a parameter.
Matrix changes(Run& run) { return varied(run).changes(run.loop->y()); }

// How much later with each parameter a coordinate, or its rate, comes to where it is now; none where it rests.
nb::object delays(Run& run, int coordinate, bool of_rate) {
  Loop& loop = *run.loop;
  WithVariation& system = varied(run);
  require_indices({coordinate}, run.core->n, "coordinate");
  Vector a(run.core->n);
  if (!loop.settle_core() || !loop.system->acceleration(loop.t(), a)) return nb::none();
  const Matrix s = system.changes(loop.y());
  if (!system.variation().delays(loop.system->velocity, a, {{coordinate, of_rate}}, s)) return nb::none();
  return nb::cast(Vector(system.variation().delay()));
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
                       {}};
  for (const auto& row : nb::cast<nb::list>(table["parameters"]))
    found.parameters.push_back(parameter_of(nb::cast<nb::tuple>(row)));
  return found;
}

void bind_variation(nb::class_<Run>& loop) {
  loop.def("changes", &changes)
      .def("delays", &delays, "coordinate"_a, "of_rate"_a)
      .def("motion", &motion)
      .def("together", [](Run& run) { return varied(run).together; });
}

}  // namespace ckc
