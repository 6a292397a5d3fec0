// The step loop as Python sees it. It runs without the interpreter's lock.
#include <cmath>
#include <memory>

#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "bdf.hpp"
#include "checks.hpp"
#include "loop.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

// A loop with all it works on.
struct Run {
  Run(System& system_, std::unique_ptr<Method> method_, Watch watch_, std::unique_ptr<Leap> leap, double closed)
      : system(system_), method(std::move(method_)), watch(std::move(watch_)),
        crossing(system_, *method, watch, std::move(leap), closed), record(system_.core),
        loop(system_, *method, watch, crossing, record) {}

  System& system;
  std::unique_ptr<Method> method;
  Watch watch;
  Crossing crossing;
  Record record;
  Loop loop;
};

// `t_old`, `y_old`: where the last step began.
void begin(Run& run, double t, Given y, Given f, double h_abs, double t_old, Given y_old) {
  require(y, run.system.size, "y"), require(f, run.system.size, "f"), require(y_old, run.system.size, "y_old");
  require(std::isfinite(t) && h_abs > 0, "a time and a positive step are needed");
  Method& method = *run.method;
  method.t = t, method.y = y, method.f = f, method.h_abs = h_abs;
  method.t_old = t_old, method.y_old = y_old;
  run.crossing.begin();
}

Bdf& bdf_of(Run& run) {
  Bdf* bdf = dynamic_cast<Bdf*>(run.method.get());
  require(bdf, "differences: the method is not BDF");
  return *bdf;
}

// BDF's memory: differences, a row each, order, steps of one length, and the Jacobian.
void remember(Run& run, Matrix D, int order, int equal, Matrix J) {
  Bdf& bdf = bdf_of(run);
  const auto size = run.system.size;
  require(order >= 1 && order <= Bdf::most && equal >= 0, "differences: an order of 1 to 5 is needed");
  require(D.rows() == Bdf::most + 3 && D.cols() == size && D.topRows(order + 1).allFinite(),
          "differences: eight rows are needed, as long as y");
  require_square(J, size, "J");
  bdf.now.D = D.transpose(), bdf.now.order = order, bdf.now.equal = equal, bdf.J = J;
}

nb::tuple memory(Run& run) {
  const Bdf& bdf = bdf_of(run);
  return nb::make_tuple(Matrix(bdf.now.D.transpose()), bdf.now.order, bdf.now.equal, bdf.J);
}

// `table`: DOP853's coefficients, BDF's tolerance of Newton's method.
std::unique_ptr<Method> method_of(const std::string& name, nb::handle table, Tolerance tolerance, int size) {
  if (name == "DOP853") return std::make_unique<Dop853>(nb::cast<Dop853::Table>(table), tolerance, size);
  require(name == "BDF", "method: DOP853 or BDF");
  return std::make_unique<Bdf>(tolerance, nb::cast<double>(table), size);
}

std::unique_ptr<Leap> leap_of(System& system, const nb::list& tables) {
  if (nb::len(tables) == 0) return nullptr;
  Dae* dae = dynamic_cast<Dae*>(&system);
  require(dae && dae->crosses && nb::len(tables) == 2, "leap: two tables and a DAE that is projected are needed");
  return std::make_unique<Leap>(*dae, nb::cast<Leap::Table>(tables[0]), nb::cast<Leap::Table>(tables[1]));
}

void make_table(Leap::Table* table, Vector nodes, Matrix at_nodes, Matrix at_places, Matrix integration,
                Matrix derivation) {
  const auto stages = nodes.size();
  const auto fits = [&](const Matrix& a, Eigen::Index rows, Eigen::Index columns) {
    return a.rows() == rows && a.cols() == columns;
  };
  require(stages > 0 && fits(at_nodes, stages + 1, stages) && at_places.rows() == stages + 1 &&
              fits(integration, stages, stages + 1) && fits(derivation, stages + 1, stages),
          "leap: matrices of one number of stages are needed");
  new (table) Leap::Table{std::move(nodes), std::move(at_nodes), std::move(at_places), std::move(integration),
                          std::move(derivation)};
}

// (why, rows): the instants recorded, a row each.
nb::tuple go(Run& run, double t_bound, double min_step, long most_rhs, double seconds,
             double last_output, bool fine, Given times, long most_rows) {
  Matrix rows(run.record.width, most_rows);
  Vector instants = times;
  Eigen::Index due = 0, filled = 0;
  Why why;
  {
    nb::gil_scoped_release released;
    why = run.loop.run({t_bound, min_step, most_rhs, seconds, last_output, fine}, instants, due, rows, filled);
  }
  const char* names[] = {"finished", "pause", "python"};
  return nb::make_tuple(names[static_cast<int>(why)], Matrix(rows.leftCols(filled).transpose()));
}

}  // namespace

void bind_loop(nb::module_& m) {
  nb::class_<Dop853::Table>(m, "Dop853Table")
      .def("__init__",
           [](Dop853::Table* table, Matrix A, Matrix A_extra, Matrix D, Vector B, Vector C, Vector C_extra, Vector E3,
              Vector E5) {
             new (table) Dop853::Table{std::move(A), std::move(A_extra), std::move(D),  std::move(B),
                                       std::move(C), std::move(C_extra), std::move(E3), std::move(E5)};
           },
           "A"_a, "A_extra"_a, "D"_a, "B"_a, "C"_a, "C_extra"_a, "E3"_a, "E5"_a);
  nb::class_<Leap::Table>(m, "LeapTable")
      .def("__init__", &make_table, "nodes"_a, "at_nodes"_a, "at_places"_a, "integration"_a, "derivation"_a);
  nb::class_<Run>(m, "Loop")
      .def("__init__",
           [](Run* self, System& system, const std::string& method, nb::handle table, double rtol, double atol, double max_step,
              Given row_scale, Given column_scale, const nb::list& leap, double closed) {
             const Core& core = system.core;
             require(row_scale, core.rows.closure.rows, "row_scale"), require(column_scale, core.n, "column_scale");
             require(rtol > 0 && atol > 0 && max_step > 0, "tolerances must be positive");
             new (self) Run(system, method_of(method, table, {rtol, atol, max_step}, system.size),
                            Watch(core, row_scale, column_scale), leap_of(system, leap), closed);
           },
           nb::keep_alive<1, 2>(), "system"_a, "method"_a, "table"_a, "rtol"_a, "atol"_a, "max_step"_a, "row_scale"_a,
           "column_scale"_a, "leap"_a, "closed"_a)
      .def("rank",
           [](Run& run, Given y) {  // (value, rate) at a state, as closed as it is
             require(y, run.system.size, "y");
             require(run.system.at_last(0.0, y), "y: the core cannot be set from it");
             const Watch::Rank found = run.watch.rank(run.system);
             return nb::make_tuple(found.value, found.rate);
           },
           "y"_a)
      .def_prop_rw(
          "chart_margin", [](const Run& run) { return run.watch.chart_margin; },
          [](Run& run, double margin) { run.watch.chart_margin = margin; })
      .def("begin", &begin, "t"_a, "y"_a, "f"_a, "h_abs"_a, "t_old"_a, "y_old"_a)
      .def("remember", &remember, "D"_a, "order"_a, "equal"_a, "J"_a)
      .def("memory", &memory)
      .def("go", &go, "t_bound"_a, "min_step"_a, "most_rhs"_a, "seconds"_a, "last_output"_a, "fine"_a,
           "times"_a, "most_rows"_a)
      .def_prop_rw(
          "growing", [](const Run& run) { return run.method->growing; },
          [](Run& run, bool growing) { run.method->growing = growing; })
      .def_prop_ro("t", [](const Run& run) { return run.method->t; })
      .def_prop_ro("y", [](const Run& run) { return Vector(run.method->y); })
      .def_prop_ro("f", [](const Run& run) { return Vector(run.method->f); })
      .def_prop_ro("h_abs", [](const Run& run) { return run.method->h_abs; })
      .def_prop_ro("before", [](const Run& run) { return nb::make_tuple(run.method->t_old, Vector(run.method->y_old)); })
      .def_prop_ro("length", [](const Run& run) { return run.loop.length; })
      .def_prop_ro("ahead", [](const Run& run) { return run.loop.ahead; })
      .def("crossings", [](Run& run) { return nb::cast(std::exchange(run.loop.crossings, {})); })  // since the last time
      .def_prop_rw(
          "end",
          [](const Run& run) { return nb::make_tuple(run.loop.end.value, run.loop.end.rate); },
          [](Run& run, std::pair<double, double> end) {
            run.loop.end = {end.first, end.second}, run.loop.begun = true;
          })
      .def("counts", [](Run& run) {  // since the last time: steps, refused ones, evaluations, Jacobians, factorizations of its own
        Method& method = *run.method;
        const auto found = nb::make_tuple(run.loop.steps, method.rejected, method.rhs, method.jacobians, method.lu);
        run.loop.steps = method.rejected = method.rhs = method.jacobians = method.lu = 0;
        return found;
      });
}

}  // namespace ckc
