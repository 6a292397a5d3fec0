// A mechanism and a controller about one state, from Python's tables.
#include <chrono>

#include <nanobind/stl/unique_ptr.h>

#include "bind/control.hpp"
#include "loops/linearization.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

std::unique_ptr<Plant> plant_of(const nb::dict& table, const Matrix& turns) {
  auto core = core_of(table);
  require(turns.cols() == core->n && turns.allFinite(), "turns: a finite column a coordinate is needed");
  return std::make_unique<Plant>(std::move(core), turns);
}

void require_state(const Plant& plant, In q_tree, In v_tree, In u_tree, const Indices& locked) {
  const Core& core = *plant.core;
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree"), require(u_tree, core.n, "u_tree");
  require_indices(locked, core.n, "locked");
}

// Everything at one state; none where J has lost rank.
nb::object at(Plant& plant, Given q_tree, Given v_tree, Given u_tree, const Indices& locked) {
  require_state(plant, q_tree, v_tree, u_tree, locked);
  if (!plant.compute(q_tree, v_tree, u_tree, locked)) return nb::none();
  plant.solve();
  nb::dict found;
  found["at"] = plant.at, found["T"] = plant.T, found["V"] = plant.V, found["A"] = plant.A, found["B"] = plant.B;
  found["acceleration"] = plant.a, found["a_q"] = plant.a_q, found["a_v"] = plant.a_v, found["a_u"] = plant.a_u;
  found["multipliers"] = plant.lambda, found["multipliers_q"] = plant.lambda_q;
  found["multipliers_v"] = plant.lambda_v, found["multipliers_u"] = plant.lambda_u;
  return found;
}

// Seconds of A and B, the least of several rounds.
double seconds(Plant& plant, Given q_tree, Given v_tree, Given u_tree, int rounds) {
  require_state(plant, q_tree, v_tree, u_tree, {});
  const Vector q = q_tree, v = v_tree, u = u_tree;
  constexpr int times = 20;
  double least = std::numeric_limits<double>::infinity();
  for (int round = 0; round < rounds; ++round) {
    const auto start = std::chrono::steady_clock::now();
    for (int k = 0; k < times; ++k) require(plant.compute(q, v, u, {}), "q_tree: J has lost rank there");
    least = std::min(least, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return least / times;
}

// A controller that measures a mechanism's state, and its motors.
class Feedback {
 public:
  Feedback(const nb::dict& table, const nb::dict& control)
      : core_(core_of(table)), control_(control_of(control, *core_, nullptr)) {}

  // What acts on the tree, and its derivatives by q' (tangent) and v'; why there is none, or none where they are not known.
  nb::object at(double t, Given q_tree, Given v_tree) {
    Core& core = *core_;
    require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
    core.set(q_tree, true), core.set_velocity(v_tree);
    Vector q(core.d), q_dot(core.d), force;
    for (int k = 0; k < core.d; ++k) q(k) = core.q_tree(core.tree.place[core.q[k]]), q_dot(k) = v_tree(core.q[k]);
    if (!control_->act({t, core, q, q_dot, core.v_tree, q_dot})) return nb::cast(control_->problem.says);
    Matrix by_q, by_v;
    if (!control_->slopes(core, by_q, by_v, force)) return nb::none();
    return nb::make_tuple(force, by_q, by_v);
  }

 private:
  std::unique_ptr<Core> core_;
  std::unique_ptr<Control> control_;
};

}  // namespace

void bind_plant(nb::module_& m) {
  nb::class_<Plant>(m, "Plant")
      .def(nb::new_(&plant_of), "core"_a, "turns"_a)
      .def("at", &at, "q_tree"_a, "v_tree"_a, "u_tree"_a, "locked"_a)
      .def("seconds", &seconds, "q_tree"_a, "v_tree"_a, "u_tree"_a, "rounds"_a);
  nb::class_<Feedback>(m, "Feedback")
      .def(nb::init<const nb::dict&, const nb::dict&>(), "core"_a, "control"_a)
      .def("at", &Feedback::at, "t"_a, "q_tree"_a, "v_tree"_a);
}

}  // namespace ckc
