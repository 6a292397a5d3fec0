// Bindings of single parts of the core, for tests.
#include <cmath>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include "bind/run.hpp"
#include "loops/articulated_elimination.hpp"
#include "loops/sparse_elimination.hpp"
#include "tree/rotation.hpp"
#include "motion/stiffness.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

// Find all sign changes of a function over [start, end] as events do; `exact`: the exact function, if `function` is
// an approximation.
nb::tuple sign_changes_of(const nb::callable& function, double start, double end, int sign, double zero_threshold,
                          nb::object exact) {
  const Vector points = sample_points();
  Vector values(points.size());
  const auto gap_of = [](const nb::object& f) -> ScalarFunction {
    return [&f](double t, double& value) { return value = nb::cast<double>(f(t)), true; };
  };
  const ScalarFunction gap = gap_of(function), better = gap_of(exact);
  for (Eigen::Index k = 0; k < points.size(); ++k) gap(start + (end - start) * points(k), values(k));
  RootSearch search;
  search.find(gap, {start, end}, values, sign, zero_threshold, exact.is_none() ? nullptr : &better);
  nb::list sign_changes;
  for (const auto& [t, direction] : search.sign_changes) sign_changes.append(nb::make_tuple(t, direction));
  return nb::make_tuple(sign_changes, search.sign, search.on_zero);
}

// A predictor of a mechanism that starts from a configuration.
struct BoundPredictor {
  std::unique_ptr<Core> core;
  Chart chart;
  Predictor predictor;

  BoundPredictor(const nb::typed<nb::dict, nb::str, nb::any>& table, VectorArg q_tree, double epsilon)
      : core(core_from_table(table)), predictor(*core, epsilon) {
    core->set_configuration(q_tree), core->compute_rho();
    chart.reset(*core, q_tree), predictor.reset(*core, q_tree, true);
  }
  void add(double t, VectorArg q_tree, VectorArg v_tree, VectorArg w) {
    core->set_configuration(q_tree), core->compute_rho();
    predictor.add(t, *core, q_tree, v_tree, w);
  }
  Vector predict(double t, VectorArg numbers, VectorArg w) {
    Vector q_tree(core->tree.nq);
    predictor.predict(t, numbers, chart, *core, w, q_tree);
    return q_tree;
  }
};

struct BoundFactor {
  Factor factor;
  int rows, columns;

  BoundFactor(int rows, int columns, const std::vector<Indices>& pattern) : rows(rows), columns(columns) {
    require(pattern.size() == static_cast<size_t>(rows), "pattern: its rows are needed");
    for (const Indices& of_row : pattern) require_indices(of_row, columns, "pattern");
    factor.set_pattern(rows, columns, pattern);
  }
  nb::typed<nb::tuple, Vector, double> solve(MatrixArg a, VectorArg b) {
    require(a.rows() == rows && a.cols() == columns, "a: another size");
    require(b, rows, "b");
    Vector x(columns);
    factor.compute(a);
    factor.solve(b, x);
    return nb::make_tuple(x, factor.pivot_ratio());
  }
};

// Sparse elimination for a mechanism of any size, even if projection is cheaper.
struct BoundSparseElimination {
  std::unique_ptr<Core> core;
  SparseElimination elimination;

  BoundSparseElimination(const nb::typed<nb::dict, nb::str, nb::any>& table)
      : core(core_from_table(table)),
        elimination(core->tree.inertia_pattern, core->constraints.pattern, get<Indices>(table, "independent_rows")) {
    core->allow_elimination(false);  // it would leave D' out
  }
  std::optional<Vector> acceleration(VectorArg q_tree, VectorArg v_tree, VectorArg u_tree) {
    core->set_configuration(q_tree, true), core->set_velocity(v_tree), core->compute_J(), core->compute_bias();
    if (!elimination.compute(core->tree.D_entries(), core->constraints.J_entries())) return std::nullopt;
    Vector a(core->n);
    elimination.solve(u_tree - core->bias_tree + core->damping_tree, core->J_dot_v, a);
    return a;
  }
};

// Elimination by articulated bodies, likewise.
struct BoundArticulatedElimination {
  std::unique_ptr<Core> core;
  ArticulatedElimination elimination;

  BoundArticulatedElimination(const nb::typed<nb::dict, nb::str, nb::any>& table)
      : core(core_from_table(table)),
        elimination(core->tree, core->constraints, get<Indices>(table, "independent_rows")) {
    core->allow_elimination(false);  // its bias is Pinocchio's
  }
  bool compute(VectorArg q_tree) {
    core->set_configuration(q_tree), core->compute_J();
    elimination.bodies.set_configuration(core->tree);
    return elimination.compute(core->constraints.J_entries());
  }
  std::optional<Vector> acceleration(VectorArg q_tree, VectorArg v_tree, VectorArg u_tree) {
    if (!compute(q_tree)) return std::nullopt;
    core->set_velocity(v_tree), core->compute_bias();
    Vector a(core->n);
    elimination.solve(u_tree - core->bias_tree + core->damping_tree, core->J_dot_v, a);
    return a;
  }
  std::optional<Matrix> unit_force_responses(VectorArg q_tree, const Indices& at) {
    if (!compute(q_tree)) return std::nullopt;
    Matrix columns(core->n, static_cast<Eigen::Index>(at.size()));
    elimination.solve_unit_forces(at, columns);
    return columns;
  }
  nb::typed<nb::tuple, Vector, Matrix, Matrix> motion(VectorArg q_tree, VectorArg v_tree) {
    core->set_configuration(q_tree);
    ArticulatedBodies& bodies = elimination.bodies;
    bodies.set_configuration(core->tree);
    const Vector bias = bodies.compute_bias(v_tree);
    const int joints = core->tree.joints;
    Matrix velocities(6, joints), accelerations(6, joints);
    for (int joint = 0; joint < joints; ++joint)
      velocities.col(joint) = bodies.velocity(joint), accelerations.col(joint) = bodies.bias_acceleration(joint);
    return nb::make_tuple(bias, velocities, accelerations);
  }
};

nb::typed<nb::tuple, Vector, Vector> weights(const Vector& times, double t) {
  Vector a(times.size()), b(times.size());
  hermite_weights(times.data(), static_cast<int>(times.size()), t, a.data(), b.data());
  return nb::make_tuple(a, b);
}

// Return the Jacobian of a rotation vector, its derivative along a, and the derivative of that along b.
nb::typed<nb::tuple, Matrix, Matrix, Matrix> log_jacobian(const Vector& u, const Vector& a, const Vector& b) {
  require(u, 3, "u"), require(a, 3, "a"), require(b, 3, "b");
  const Vector3 direction_a = a, direction_b = b;
  const LogJacobian log{Vector3(u)};
  return nb::make_tuple(Matrix(log.value), Matrix(log.derivative(direction_a)),
                        Matrix(log.second_derivative(direction_a, direction_b)));
}

// Return a rank monitor's smallest singular values and their rates at states of a DAE, one after the other.
Matrix ranks(Loop& loop, MatrixArg states) {
  System& system = *loop.step_loop->system;
  require(states.cols() == system.size, "states: rows y are needed");
  RankMonitor monitor(*loop.core);
  Matrix values_and_rates(states.rows(), 2);
  for (Eigen::Index k = 0; k < states.rows(); ++k) {
    const Vector y = states.row(k);
    system.sync_core_at_last_rhs(0.0, y);
    const RankMonitor::Rank sigma_min = monitor.evaluate(system);
    values_and_rates.row(k) << sigma_min.value, sigma_min.rate;
  }
  return values_and_rates;
}

// Return the end of one collocation step from the present state.
Vector collocate(Loop& loop, double span, int stages) {
  System& system = *loop.step_loop->system;
  const Step& now = loop.step_loop->now;
  const Tolerance tightest{0.0, 0.0, 0.0};
  Collocation step(system, loop.step_loop->work, tightest, stages, std::max(stages - 2, 2));
  Vector y(system.size);
  step.make_step(now.t, now.y, span, false);
  step.evaluate(now.t + span, y);
  return y;
}

std::optional<Vector> rate_on_manifold(Loop& loop, double t, VectorArg y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  Vector y_dot(system.size);
  return system.rate_on_manifold(t, y, y_dot) ? std::optional(y_dot) : std::nullopt;
}

// Project (q', v') onto the constraint manifold.
std::optional<std::pair<Vector, Vector>> project(Loop& loop, double t, VectorArg y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  if (!system.sync_core(t, y)) return {};
  return std::pair(loop.core->q_tree, system.velocity);
}

// Return the reduced Jacobian that decides about stiffness.
std::optional<Matrix> reduced_jacobian(Loop& loop, Matrix jacobian) {
  const Step& now = loop.step_loop->now;
  return loop.step_loop->system->reduce_to_freedoms(now.y, jacobian) ? std::optional(jacobian) : std::nullopt;
}

}  // namespace

void bind_parts(nb::module_& m, nb::class_<Loop>& binding) {
  m.def(
      "find_sign_changes", &sign_changes_of, "function"_a, "start"_a, "end"_a, nb::kw_only(), "sign"_a = 0,
      "zero_threshold"_a = 0.0, "exact"_a.none() = nb::none(),
      nb::sig("def find_sign_changes(function: collections.abc.Callable[[float], float], start: float, end: float, *, "
              "sign: int = 0, zero_threshold: float = 0.0, exact: collections.abc.Callable[[float], float] | None = "
              "None) -> tuple[list[tuple[float, int]], int, bool]"),
      "Find the sign changes of a function as events do: ([(t, direction)], last sign, whether it ends on zero).");
  m.def("is_stiff", &is_stiff, "jacobian"_a, "duration"_a, "Decide whether a linear system of this duration is stiff.");
  m.def("log_jacobian", &log_jacobian, "u"_a, "a"_a, "b"_a,
        "Return the Jacobian of a rotation vector, its derivative along a, and that one's derivative along b.");
  m.def("hermite_weights", &weights, "times"_a, "t"_a,
        "Return the weights of values and of derivatives of Hermite interpolation.");
  nb::class_<BoundPredictor>(m, "Predictor", "Extrapolates the configuration as a starting point of the projection.")
      .def(nb::init<const nb::typed<nb::dict, nb::str, nb::any>&, VectorArg, double>(), "core"_a, "q_tree"_a,
           "epsilon"_a)
      .def("add", &BoundPredictor::add, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a)
      .def("predict", &BoundPredictor::predict, "t"_a, "numbers"_a, "w"_a);
  nb::class_<BoundFactor>(m, "Factor", "LU factorization of sparse square matrices, or QR of tall ones.")
      .def(nb::init<int, int, const std::vector<Indices>&>(), "rows"_a, "columns"_a, "pattern"_a)
      .def("solve", &BoundFactor::solve, "a"_a, "b"_a,
           "Factorize a matrix of this pattern; return the solution and the smallest pivot over the largest.")
      .def_prop_ro("singular", [](const BoundFactor& bound) { return bound.factor.singular(); });
  nb::class_<BoundSparseElimination>(m, "SparseElimination", "Eliminates eq. 1 in sparse matrices, without pivoting.")
      .def(nb::init<const nb::typed<nb::dict, nb::str, nb::any>&>(), "core"_a)
      .def("acceleration", &BoundSparseElimination::acceleration, "q_tree"_a, "v_tree"_a, "u_tree"_a,
           "Return the acceleration of eq. 1; None if a pivot is small.")
      .def_prop_ro("operations", [](const BoundSparseElimination& of) { return of.elimination.operations(); },
                   "Multiplications of a factorization and a solution.");
  nb::class_<BoundArticulatedElimination>(m, "ArticulatedElimination",
                                          "Eliminates eq. 1 by articulated bodies, without pivoting.")
      .def(nb::init<const nb::typed<nb::dict, nb::str, nb::any>&>(), "core"_a)
      .def("acceleration", &BoundArticulatedElimination::acceleration, "q_tree"_a, "v_tree"_a, "u_tree"_a,
           "Return the acceleration of eq. 1; None if a pivot is small.")
      .def("unit_force_responses", &BoundArticulatedElimination::unit_force_responses, "q_tree"_a, "at"_a,
           "Return the accelerations that unit forces on coordinates cause, one column each; None if a pivot is small.")
      .def("motion", &BoundArticulatedElimination::motion, "q_tree"_a, "v_tree"_a,
           "Return C'v + h' without springs, and the joints' velocities and bias accelerations, one column each, in "
           "world axes at the world's origin.")
      .def_prop_ro("operations",
                   [](const BoundArticulatedElimination& of) {
                     return of.core->n + of.elimination.visits() + of.elimination.operations();
                   },
                   "Coordinates that all sweeps visit, and multiplications with the matrix of the rows.");
  binding
      .def("ranks", &ranks, "states"_a,
           "Return the rank monitor's smallest singular value of J and its rate at a DAE's states, one row for each.")
      .def("reduced_jacobian", &reduced_jacobian, "jacobian"_a,
           "Return the Jacobian in minimal coordinates, whose eigenvalues decide about stiffness.")
      .def("collocate", &collocate, "span"_a, "stages"_a,
           "Return the end of one collocation step from the present state.")
      .def("rate_on_manifold", &rate_on_manifold, "t"_a, "y"_a,
           "Project a state onto the constraint manifold and return its rate; None if there is none.")
      .def("project", &project, "t"_a, "y"_a,
           "Return (q', v') of a state projected onto the constraint manifold; None if that fails.")
      .def_prop_rw(  // of the next step; 0 lets the method estimate it
          "step_size", [](const Loop& loop) { return loop.step_loop->now.h; },
          [](Loop& loop, double step_size) { loop.step_loop->now.h = step_size; })
      .def_prop_rw(
          "newton_tolerance", [](const Loop& loop) { return loop.step_loop->newton_tolerance(); },
          [](Loop& loop, double tolerance) { loop.step_loop->newton_tolerance() = tolerance; });
}

}  // namespace ckc
