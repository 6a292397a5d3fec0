// Parts of the core one by one, for the tests.
#include <cmath>

#include "bind/run.hpp"
#include "tree/rotation.hpp"
#include "motion/stiffness.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

// All sign changes of a function over [start, end], as events find them: ([(t, direction)], sign, on zero); `exact`: the
// function where the other one is a little off.
nb::tuple walk_over(const nb::callable& function, double start, double end, int sign, double floor, nb::object exact) {
  const Vector places = walk_places();
  Vector values(places.size());
  const auto gap_of = [](const nb::object& f) -> Gap {
    return [&f](double t, double& value) { return value = nb::cast<double>(f(t)), true; };
  };
  const Gap gap = gap_of(function), better = gap_of(exact);
  for (Eigen::Index k = 0; k < places.size(); ++k) gap(start + (end - start) * places(k), values(k));
  Walk walked;
  walk(gap, start, end, values, sign, floor, walked, exact.is_none() ? nullptr : &better);
  nb::list found;
  for (const auto& [t, direction] : walked.found) found.append(nb::make_tuple(t, direction));
  return nb::make_tuple(found, walked.sign, walked.on_zero);
}

// A predictor on a mechanism, which starts from a configuration.
struct Predicting {
  std::unique_ptr<Core> core;
  Chart chart;
  Predictor predictor;

  Predicting(const nb::dict& table, Given q_tree, double epsilon) : core(core_of(table)), predictor(*core, epsilon) {
    core->set(q_tree), core->reduce();
    chart.start(*core, q_tree), predictor.start(*core, q_tree);
  }
  void add(double t, Given q_tree, Given v_tree, Given w) {
    core->set(q_tree), core->reduce();
    predictor.add(t, *core, q_tree, v_tree, w);
  }
  Vector predict(double t, Given numbers, Given w) {
    Vector q_tree(core->tree.nq);
    predictor.predict(t, numbers, chart, *core, w, q_tree);
    return q_tree;
  }
};

nb::tuple weights(const Vector& times, double t) {
  Vector a(times.size()), b(times.size());
  hermite_weights(times.data(), static_cast<int>(times.size()), t, a.data(), b.data());
  return nb::make_tuple(a, b);
}

// The matrix by which a rotation vector moves, its derivative along a, and of that along b.
nb::tuple log_rates(const Vector& u, const Vector& a, const Vector& b) {
  require(u, 3, "u"), require(a, 3, "a"), require(b, 3, "b");
  const Vector3 along_a = a, along_b = b;
  const LogRate found{Vector3(u)};
  return nb::make_tuple(Matrix(found.value), Matrix(found.along(along_a)), Matrix(found.along(along_a, along_b)));
}

Dae& dae_of(Run& run) {
  Dae* dae = dynamic_cast<Dae*>(run.loop->system.get());
  require(dae, "a DAE is needed");
  return *dae;
}

// What the rank monitor has of J, scaled: its least singular value, and its rate, at a state of a DAE as it is.
nb::tuple rank(Run& run, Given y) {
  Dae& dae = dae_of(run);
  require(y, dae.size, "y");
  dae.at_last(0.0, y);
  const RankMonitor::Rank found = RankMonitor(*run.core).at(dae);
  return nb::make_tuple(found.value, found.rate);
}

// Where one collocation step of so many stages from the present state ends.
Vector collocate(Run& run, double span, int stages) {
  Dae& dae = dae_of(run);
  const Step& now = run.loop->now;
  Collocation step(dae, run.loop->work, stages, stages);
  Vector y(dae.size);
  step.make(now.t, now.y, span, false);
  step.at(now.t + span, y);
  return y;
}

nb::object rate_on_closure(Run& run, double t, Given y) {
  Dae& dae = dae_of(run);
  require(y, dae.size, "y");
  Vector y_dot(dae.size);
  return dae.rate_on_closure(t, y, y_dot) ? nb::cast(y_dot) : nb::none();
}

// (q', v') put on the closure.
nb::object on_closure(Run& run, double t, Given y) {
  Dae& dae = dae_of(run);
  require(y, dae.size, "y");
  if (!dae.exact(t, y)) return nb::none();
  return nb::make_tuple(Vector(run.core->q_tree), Vector(dae.velocity));
}

// The modes by which a motion counts as stiff.
nb::object modes(Run& run, Matrix jacobian) {
  const Step& now = run.loop->now;
  return run.loop->system->modes(now.y, jacobian) ? nb::cast(jacobian) : nb::none();
}

}  // namespace

void bind_parts(nb::module_& m, nb::class_<Run>& loop) {
  m.def("walk", &walk_over, "function"_a, "start"_a, "end"_a, "sign"_a, "floor"_a,
        "exact"_a.none() = nb::none());
  m.def("stiff", &stiff, "jacobian"_a, "duration"_a);
  m.def("log_rates", &log_rates, "u"_a, "a"_a, "b"_a);
  m.def("hermite_weights", &weights, "times"_a, "t"_a);
  nb::class_<Predicting>(m, "Predictor")
      .def(nb::init<const nb::dict&, Given, double>(), "core"_a, "q_tree"_a, "epsilon"_a)
      .def("add", &Predicting::add, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a)
      .def("predict", &Predicting::predict, "t"_a, "numbers"_a, "w"_a);
  loop.def("rank", &rank, "y"_a)
      .def("modes", &modes, "jacobian"_a)
      .def("collocate", &collocate, "span"_a, "stages"_a)
      .def("rate_on_closure", &rate_on_closure, "t"_a, "y"_a)
      .def("on_closure", &on_closure, "t"_a, "y"_a)
      .def_prop_rw(  // of the next step; 0 for one that is estimated
          "length", [](const Run& run) { return run.loop->now.h; },
          [](Run& run, double length) { run.loop->now.h = length; })
      .def_prop_rw(
          "newton_tolerance", [](const Run& run) { return run.loop->newton_tolerance(); },
          [](Run& run, double tolerance) { run.loop->newton_tolerance() = tolerance; });
}

}  // namespace ckc
