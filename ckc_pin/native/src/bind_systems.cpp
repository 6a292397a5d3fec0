// The formulations as Python sees them.
#include <algorithm>
#include <chrono>
#include <limits>

#include "checks.hpp"
#include "dae.hpp"
#include "level_set.hpp"
#include "printed_spf.hpp"
#include "record.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr const char* free_root = "a free root: its place is no number";

bool single(const Core& core, const Indices& coordinates) {
  const Indices& all = core.tree.single;
  return std::all_of(coordinates.begin(), coordinates.end(),
                     [&](int k) { return std::binary_search(all.begin(), all.end(), k); });
}

void require_state(const System& system, Given y) { require(y, system.size, "y"); }

nb::object rhs(System& system, double t, Given y) {
  require_state(system, y);
  Vector y_dot(y.size());
  return system.rhs(t, y, y_dot) ? nb::cast(y_dot) : nb::none();
}

// A row of y' for each instant and row of states, none of them on the closure yet; NaN where it does not exist.
Matrix rates_on_closure(Dae& system, Given times, Table states) {
  require(states.cols() == system.size && states.allFinite(), "states: rows of as many finite numbers as y has");
  require(times, states.rows(), "times");
  Matrix rates(system.size, states.rows());
  Vector y(system.size);
  for (Eigen::Index k = 0; k < states.rows(); ++k) {
    y = states.row(k).transpose();
    if (!system.rate_on_closure(times(k), y, rates.col(k)))
      rates.col(k).setConstant(std::numeric_limits<double>::quiet_NaN());
  }
  return rates.transpose();
}

nb::object projected(Dae& system, Given y) {
  require_state(system, y);
  if (!system.project(y)) return nb::none();
  return nb::make_tuple(Vector(system.core.q_tree), Vector(system.velocity));
}

nb::object jacobian(LevelSet& system, double t, Given y) {
  require_state(system, y);
  Matrix found(y.size(), y.size());
  return system.jacobian(t, y, found) ? nb::cast(found) : nb::none();
}

// (q', v') on the level set, with v' what C takes its velocity from.
nb::object open(LevelSet& system, double t, Given y) {
  require_state(system, y);
  if (!system.open(t, y)) return nb::none();
  return nb::make_tuple(Vector(system.core.q_tree), Vector(system.v_tree));
}

Vector finish(LevelSet& system, Given u_tree) {
  require(u_tree, system.core.n, "u_tree");
  Vector y_dot(system.size);
  system.finish(u_tree, y_dot);
  return y_dot;
}

void add(LevelSet& system, double t, Given q_tree, Given v_tree, Given w) {
  Core& core = system.core;
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  require(w, core.rows.closure.rows, "w");
  core.set(q_tree), core.factor(), core.reduce();
  system.trail.add(t, core, q_tree, v_tree, w);
}

Vector predict(LevelSet& system, double t, Given q, Given w) {
  const Core& core = system.core;
  require(q, core.d, "q"), require(w, core.rows.closure.rows, "w");
  Vector q_tree(core.tree.nq);
  system.trail.predict(t, q, core, w, q_tree);
  return q_tree;
}

void harmonics(System& system, Matrix Lambda, Matrix K_D, Vector offset, Matrix amplitude, Matrix frequency,
               Matrix phase) {
  const int d = system.core.d;
  require_square(Lambda, d, "Lambda"), require_square(K_D, d, "K_D"), require(offset, d, "offset");
  for (const Matrix& m : {amplitude, frequency, phase})
    require(m.rows() == d && m.cols() == amplitude.cols() && m.allFinite(), "harmonics: a row of finite numbers each");
  system.drive.tracking = {Lambda, K_D, {offset, amplitude, frequency, phase, {}, {}}};
}

void spline(System& system, Matrix Lambda, Matrix K_D, Vector breaks, std::vector<Matrix> coefficients) {
  const int d = system.core.d;
  require_square(Lambda, d, "Lambda"), require_square(K_D, d, "K_D");
  require(breaks.size() > 1, "spline: at least two breaks are needed"), require(breaks, breaks.size(), "breaks");
  for (const Matrix& c : coefficients)
    require(c.rows() == breaks.size() - 1 && c.cols() == d && c.allFinite(), "spline: a row of coefficients a piece");
  system.drive.tracking = {Lambda, K_D, {{}, {}, {}, {}, breaks, coefficients}};
}

// What a run keeps of an instant, as `Record` has it; none where the state has no terms.
nb::object row(System& system, double t, Given y) {
  require(y, system.size, "y");
  Record record(system.core);
  Vector found(record.width);
  return record.row(system, t, y, found) ? nb::cast(found) : nb::none();
}

// Seconds of a right-hand side, the least of several rounds over states of a motion, a row of (t, y) each; of
// Pinocchio's own calls for its terms: J with its rate, D', C'v + h', and J for each of Newton's corrections; and how
// many of those there were.
nb::tuple seconds(System& system, Table states, int rounds) {
  require(states.cols() == 1 + system.size && states.rows() > 0 && rounds > 0, "states: rows of (t, y) are needed");
  using Clock = std::chrono::steady_clock;
  const auto since = [](Clock::time_point start) {
    return std::chrono::duration<double>(Clock::now() - start).count();
  };
  const Matrix columns = states.transpose();
  Core& core = system.core;
  Vector y_dot(system.size);
  Matrix q_trees(core.tree.nq, columns.cols()), v_trees(core.n, columns.cols());
  double own = 1e300, pinocchio = 1e300;
  long corrections = 0;
  nb::gil_scoped_release released;
  for (int round = 0; round < rounds; ++round) {
    const long before = system.counts.newton;
    auto start = Clock::now();
    for (Eigen::Index k = 0; k < columns.cols(); ++k)
      require(system.rhs(columns(0, k), columns.col(k).tail(system.size), y_dot), "states: no right-hand side there");
    own = std::min(own, since(start));
    corrections = system.counts.newton - before;
    for (Eigen::Index k = 0; k < columns.cols() && round == 0; ++k) {
      system.exact(columns(0, k), columns.col(k).tail(system.size));
      q_trees.col(k) = core.q_tree, v_trees.col(k) = system.v_tree;
    }
    start = Clock::now();
    for (Eigen::Index k = 0; k < columns.cols(); ++k) {
      core.tree.jacobian_rate(q_trees.col(k), v_trees.col(k));
      core.tree.inertia(q_trees.col(k));
      core.tree.bias(q_trees.col(k), v_trees.col(k));
    }
    for (long k = 0; k < corrections; ++k) core.tree.set(q_trees.col(k % columns.cols()));
    pinocchio = std::min(pinocchio, since(start));
  }
  const double count = static_cast<double>(columns.cols());
  nb::gil_scoped_acquire acquired;
  return nb::make_tuple(own / count, pinocchio / count, corrections / count);
}

}  // namespace

void bind_systems(nb::module_& m) {
  nb::class_<System>(m, "System")
      .def("rhs", &rhs, "t"_a, "y"_a)
      .def("row", &row, "t"_a, "y"_a)
      .def("seconds", &seconds, "states"_a, "rounds"_a)
      .def("counts", [](System& system) {  // since the last time: Newton corrections, factorizations
             const Counts counts = system.counts;
             system.counts = {};
             return nb::make_tuple(counts.newton, counts.factorizations);
           })
      .def("hold", [](System& system, Given u) {
             require(u, system.core.d, "u");
             system.drive.held = u;
           }, "u"_a)
      .def("limit", [](System& system, Given limit) {
             require(limit.size() == system.core.d && (limit.array() >= 0).all(), "limit: a positive number each");
             system.drive.limit = limit;
           }, "limit"_a)
      .def("set_point", [](System& system, Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential) {
             const int d = system.core.d;
             require_square(K_P, d, "K_P"), require_square(K_V, d, "K_V");
             require(q_d, d, "q_d"), require(h_d, d, "h_d");
             system.drive.set_point = {K_P, K_V, q_d, h_d, potential};
           }, "K_P"_a, "K_V"_a, "q_d"_a, "h_d"_a, "potential"_a)
      .def("harmonics", &harmonics, "Lambda"_a, "K_D"_a, "offset"_a, "amplitude"_a, "frequency"_a, "phase"_a)
      .def("spline", &spline, "Lambda"_a, "K_D"_a, "breaks"_a, "coefficients"_a);
  nb::class_<LevelSet, System>(m, "LevelSet")
      .def("__init__",
           [](LevelSet* self, Core& core, Given q_tree, double epsilon, bool actual, Given w0, double tolerance,
              double slack) {
             require(q_tree, core.tree.nq, "q_tree"), require(w0, core.rows.closure.rows, "w0");
             require(single(core, core.q), free_root);
             require(epsilon > 0 && tolerance > 0 && slack >= 0, "epsilon and tolerance must be positive");
             new (self) LevelSet(core, epsilon, actual, w0, tolerance, slack);
             core.set(q_tree), core.factor(), core.reduce();
             self->start(q_tree);
           },
           nb::keep_alive<1, 2>(), "core"_a, "q_tree"_a, "epsilon"_a, "actual"_a, "w0"_a, "tolerance"_a, "slack"_a)
      .def("last", [](const LevelSet& system) { return Vector(system.trail.last()); })
      .def("predict", &predict, "t"_a, "q"_a, "w"_a)
      .def("add", &add, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a)
      .def("open", &open, "t"_a, "y"_a)
      .def("finish", &finish, "u_tree"_a)
      .def("jacobian", &jacobian, "t"_a, "y"_a);
  nb::class_<Dae, System>(m, "Dae")
      .def("__init__",
           [](Dae* self, Core& core, double tolerance, bool projects, double alpha, double beta) {
             require(tolerance > 0 && alpha >= 0 && beta >= 0, "tolerance, alpha and beta must not be negative");
             new (self) Dae(core, tolerance, projects, alpha, beta);
           },
           nb::keep_alive<1, 2>(), "core"_a, "tolerance"_a, "projects"_a, "alpha"_a, "beta"_a)
      .def("projected", &projected, "y"_a)
      .def("rates_on_closure", &rates_on_closure, "times"_a, "states"_a);
  nb::class_<PrintedSpf, System>(m, "PrintedSpf")
      .def("__init__",
           [](PrintedSpf* self, Core& core, double epsilon, bool actual, Given w0) {
             require(core.tree.roots.empty(), free_root), require(w0, core.rows.closure.rows, "w0");
             require(epsilon > 0, "epsilon must be positive");
             new (self) PrintedSpf(core, epsilon, actual, w0);
           },
           nb::keep_alive<1, 2>(), "core"_a, "epsilon"_a, "actual"_a, "w0"_a);
}

}  // namespace ckc
