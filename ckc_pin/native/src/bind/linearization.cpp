// Bindings of the linearization of a mechanism, and of a controller's derivatives.
#include <chrono>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>

#include "bind/control.hpp"
#include "loops/linearization.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

std::unique_ptr<Linearization> linearization_from_table(const nb::typed<nb::dict, nb::str, nb::any>& table,
                                                        const Matrix& transmission) {
  auto core = core_from_table(table);
  require(transmission.cols() == core->n && transmission.allFinite(),
          "transmission: a finite column per coordinate is needed");
  return std::make_unique<Linearization>(std::move(core), transmission);
}

void require_state(const Linearization& linearization, In q_tree, In v_tree, In u_tree, const Indices& locked) {
  const Core& core = *linearization.core;
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree"), require(u_tree, core.n, "u_tree");
  require_indices(locked, core.n, "locked");
}

// Return the linearization at one state under u' and forces on links, where rows accelerate by -correction; None if J has lost rank.
std::optional<nb::typed<nb::dict, nb::str, nb::any>> linearize(Linearization& linearization, VectorArg q_tree,
                                                               VectorArg v_tree, VectorArg u_tree,
                                                               const Indices& locked,
                                                               const std::vector<nb::dict>& forces,
                                                               VectorArg correction) {
  require_state(linearization, q_tree, v_tree, u_tree, locked);
  require(correction, linearization.core->constraints.closure.rows, "correction");
  Core& core = *linearization.core;
  Vector force = u_tree;
  Matrix force_by_q;
  if (!forces.empty()) {
    const auto on_links = forces_from_tables(forces, core, nullptr);
    const Vector none;
    ControlFailure failure;
    core.set_configuration(q_tree);
    on_links->compute({0.0, core, none, none, none, none}, failure);
    force += on_links->value, force_by_q.setZero(core.n, core.n);
    require(on_links->add_derivative(core, force_by_q), "forces: constant ones are needed");
  }
  if (!linearization.compute(q_tree, v_tree, force, locked, force_by_q, correction)) return {};
  linearization.solve_multipliers();
  nb::typed<nb::dict, nb::str, nb::any> result;
  result["at"] = linearization.coordinates, result["T"] = linearization.T, result["V"] = linearization.V,
  result["A"] = linearization.A, result["B"] = linearization.B;
  result["acceleration"] = linearization.acceleration.a, result["a_q"] = linearization.acceleration.by_q,
  result["a_v"] = linearization.acceleration.by_v, result["a_u"] = linearization.acceleration.by_u;
  result["multipliers"] = linearization.lambda, result["multipliers_q"] = linearization.lambda_q;
  result["multipliers_v"] = linearization.lambda_v, result["multipliers_u"] = linearization.lambda_u;
  return result;
}

// Return the time to compute A and B, s: minimum of several rounds.
double seconds(Linearization& linearization, VectorArg q_tree, VectorArg v_tree, VectorArg u_tree, int rounds) {
  require_state(linearization, q_tree, v_tree, u_tree, {});
  const Vector q = q_tree, v = v_tree, u = u_tree,
               none = Vector::Zero(linearization.core->constraints.closure.rows);
  constexpr int repetitions = 20;
  double shortest = std::numeric_limits<double>::infinity();
  for (int round = 0; round < rounds; ++round) {
    const auto start = std::chrono::steady_clock::now();
    for (int k = 0; k < repetitions; ++k) require(linearization.compute(q, v, u, {}, {}, none), "q_tree: J has lost rank there");
    shortest = std::min(shortest, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return shortest / repetitions;
}

// A controller with its motors, evaluated and differentiated at one state.
class Feedback {
 public:
  Feedback(const nb::dict& table, const nb::dict& control)
      : core_(core_from_table(table)), control_(control_from_table(control, *core_, nullptr)) {}

  // Return the force on the tree and its derivatives with respect to q' (tangent) and v'. If there is no force,
  // return the reason; None if the derivatives are unknown.
  nb::object at(double t, VectorArg q_tree, VectorArg v_tree) {
    Core& core = *core_;
    require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
    core.set_configuration(q_tree, true), core.set_velocity(v_tree);
    Vector q(core.d), q_dot(core.d), force;
    for (int k = 0; k < core.d; ++k) q(k) = core.q_tree(core.tree.q_index[core.q[k]]), q_dot(k) = v_tree(core.q[k]);
    if (!control_->compute({t, core, q, q_dot, core.v_tree, q_dot})) return nb::cast(control_->failure.message);
    Matrix by_q, by_v;
    if (!control_->derivatives(core, by_q, by_v, force)) return nb::none();
    return nb::make_tuple(force, by_q, by_v);
  }

 private:
  std::unique_ptr<Core> core_;
  std::unique_ptr<Control> control_;
};

}  // namespace

void bind_linearization(nb::module_& m) {
  nb::class_<Linearization>(m, "Linearization", "Linearizes eq. 1 at one state after another.")
      .def(nb::new_(&linearization_from_table), "core"_a, "transmission"_a)
      .def("at", &linearize, "q_tree"_a, "v_tree"_a, "u_tree"_a, "locked"_a, "forces"_a, "correction"_a,
           nb::sig("def at(self, q_tree: numpy.typing.NDArray[numpy.float64], v_tree: "
                   "numpy.typing.NDArray[numpy.float64], u_tree: numpy.typing.NDArray[numpy.float64], "
                   "locked: list[int], forces: list[dict[str, typing.Any]], "
                   "correction: numpy.typing.NDArray[numpy.float64]) -> dict[str, typing.Any] | None"),
           "Return the linearization at one state; None if J has lost rank.")
      .def("seconds", &seconds, "q_tree"_a, "v_tree"_a, "u_tree"_a, "rounds"_a);
  nb::class_<Feedback>(m, "Feedback", "A controller with its motors, evaluated and differentiated at one state.")
      .def(nb::init<const nb::dict&, const nb::dict&>(), "core"_a, "control"_a,
           nb::sig("def __init__(self, core: dict[str, typing.Any], control: dict[str, typing.Any]) -> None"))
      .def("at", &Feedback::at, "t"_a, "q_tree"_a, "v_tree"_a,
           nb::sig("def at(self, t: float, q_tree: numpy.typing.NDArray[numpy.float64], v_tree: "
                   "numpy.typing.NDArray[numpy.float64]) -> tuple[numpy.typing.NDArray[numpy.float64], "
                   "numpy.typing.NDArray[numpy.float64], numpy.typing.NDArray[numpy.float64]] | str | None"),
           "Return the force on the tree and its derivatives by q' and v'; a reason if there is no force; None if the "
           "derivatives are unknown.");
}

}  // namespace ckc
