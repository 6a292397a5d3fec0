// Bindings of the step loop. It runs without the interpreter's lock, except in callbacks.
#include <algorithm>
#include <chrono>
#include <cmath>

#include <nanobind/stl/unique_ptr.h>

#include "bind/run.hpp"
#include "loops/compiled_terms.hpp"
#include "motion/printed_spf.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

using RecordArray = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr const char* method_names[] = {"DOP853", "RK45", "Radau"};

std::unique_ptr<System> system_from_table(Core& core, Control& control, const nb::dict& table) {
  const auto kind = get<std::string>(table, "kind");
  const double tolerance = get<double>(table, "tolerance");
  require(tolerance > 0, "tolerance: a positive number is needed");
  if (kind == "dae") {
    const double alpha = get<double>(table, "alpha"), beta = get<double>(table, "beta");
    require(alpha >= 0 && beta >= 0, "alpha and beta: nonnegative numbers are needed");
    const bool projects = get<bool>(table, "projects");
    require(!table.contains("sensitivities") || (projects && alpha == 0 && beta == 0),
            "sensitivities: the DAE must be projected onto the constraint manifold");
    return std::make_unique<Dae>(core, control, tolerance, projects, alpha, beta);
  }
  const double epsilon = get<double>(table, "epsilon");
  const bool actual = get<bool>(table, "actual");
  require(epsilon > 0, "epsilon: a positive number is needed");
  if (kind == "level_set")
    return std::make_unique<LevelSet>(core, control, epsilon, actual, tolerance, get<double>(table, "rhs_tolerance"));
  require(kind == "printed", "formulation: the kind must be dae, level_set or printed");
  require(core.tree.roots.empty(), "eq. 8 as printed: trees with free roots are not supported");
  return std::make_unique<PrintedSpf>(core, control, epsilon, actual);
}

PrescribedJoint prescribed_from_table(const nb::dict& table, const Core& core, Eigen::Index motors,
                                      std::vector<Event>& events) {
  PrescribedJoint joint{get<int>(table, "coordinate"),
                        get<int>(table, "row"),
                        get<int>(table, "motor"),
                        get<double>(table, "offset"),
                        get<double>(table, "gear"),
                        get<double>(table, "friction"),
                        trajectory_from_table(get<nb::dict>(table, "motion"), 1),
                        get<Vector>(table, "corners"),
                        {get<double>(table, "begins_at"), get<Indices>(table, "begins_with")},
                        {get<double>(table, "ends_at"), get<Indices>(table, "ends_with")}};
  require_indices({joint.coordinate}, core.n, "prescribed joint");
  require_indices({joint.row}, core.constraints.closure.rows, "row of a prescribed joint");
  require_indices({joint.motor}, static_cast<int>(motors), "motor of a prescribed joint");
  for (const auto& change : {joint.begins, joint.ends}) {
    require_indices(change.events, static_cast<int>(events.size()), "events of a prescribed joint");
    for (int k : change.events) events[static_cast<size_t>(k)].switches_joints = true;
  }
  return joint;
}

Event event_from_table(const EventTable& table, const Core& core, const std::shared_ptr<View>& view) {
  Event event = table.event;
  require_indices({event.coordinate}, core.n, "event");
  if (event.quantity != Event::function) return event;
  auto function = std::make_shared<nb::object>(table.function);
  event.evaluate = [function, view](double t, System& system, double& value) {
    nb::object answer;
    ControlFailure& failure = system.control.failure;
    if (!view->call(*function, system.measured(t), failure, answer)) return false;
    nb::gil_scoped_acquire acquired;
    if (nb::isinstance<nb::str>(answer))
      failure.message = nb::cast<std::string>(answer);
    else
      value = nb::cast<double>(answer);
    answer.reset();
    return failure.message.empty();
  };
  return event;
}

}  // namespace

void prepare(Loop& loop, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
             const nb::dict& solver, const nb::list& events) {
  loop.core = core_from_table(core);
  auto owned_control = control_from_table(control, *loop.core, loop.view);
  auto system = system_from_table(*loop.core, *owned_control, formulation);
  std::vector<Event> list;
  for (nb::handle item : events)
    list.push_back(event_from_table(nb::cast<const EventTable&>(item), *loop.core, loop.view));
  std::vector<PrescribedJoint> prescribed;
  if (formulation.contains("prescribed"))
    for (const auto& joint : get<std::vector<nb::dict>>(formulation, "prescribed"))
      prescribed.push_back(prescribed_from_table(joint, *loop.core, owned_control->tau.size(), list));
  if (!prescribed.empty()) system->prescribe(std::move(prescribed));
  if (formulation.contains("forces"))
    system->set_forces(
        forces_from_tables(get<std::vector<nb::dict>>(formulation, "forces"), *loop.core, loop.view));
  if (formulation.contains("breakpoints")) {
    const auto breakpoints = get<nb::dict>(formulation, "breakpoints");
    system->set_breakpoints({get<Vector>(breakpoints, "times"), get<double>(breakpoints, "tolerance")});
  }
  if (get<bool>(formulation, "works")) system->integrate_works();
  std::unique_ptr<SensitivityIntegrand> sensitivities;
  if (formulation.contains("sensitivities"))
    sensitivities = std::make_unique<SensitivityIntegrand>(
        *system, sensitivity_table(nb::cast<nb::dict>(formulation["sensitivities"])));
  loop.sensitivities = sensitivities.get();
  const Options options{
      get<std::string>(solver, "method"),       get<double>(solver, "rtol"),     get<double>(solver, "atol"),
      get<double>(solver, "max_step"),          get<double>(solver, "min_step"), get<long>(solver, "max_rhs"),
      get<double>(solver, "manifold_tolerance")};
  const bool is_known = options.method == "auto" || std::find(std::begin(method_names), std::end(method_names),
                                                              options.method) != std::end(method_names);
  require(is_known, "method: " + options.method + " is unknown");
  require(options.rtol > 0 && options.atol > 0 && options.max_step > 0,
          "rtol, atol and max_step: positive numbers are needed");
  loop.core->profile.on = get<bool>(solver, "profile");
  loop.step_loop = std::make_unique<StepLoop>(std::move(owned_control), std::move(system), std::move(sensitivities),
                                              options, std::move(list));
}

namespace {

void construct(Loop* self, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
               const nb::dict& solver, const nb::list& events) {
  new (self) Loop;
  prepare(*self, core, formulation, control, solver, events);
}

void start(Loop& loop, double t, VectorArg q_tree, VectorArg v_tree, VectorArg w) {
  const Core& core = *loop.core;
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree"),
      require(w, core.constraints.closure.rows, "w");
  require(std::isfinite(t), "t: a number is not finite");
  loop.view->calls = 0, loop.view->term_requested = false, loop.rhs_before_compiled = 0;
  loop.step_loop->start(t, q_tree, v_tree, w);
}

// Use compiled terms from here on.
void use_compiled_terms(Loop& loop, const nb::tuple& library) {
  if (!loop.core->compiled) loop.rhs_before_compiled = loop.step_loop->work.rhs;
  loop.core->compiled = compiled_terms_from(library);
  loop.step_loop->sync_core();
}

void record(Loop& loop, VectorArg instants, RecordArray rows) {
  require(instants, instants.size(), "instants");
  require(rows.shape(1) == static_cast<size_t>(loop.step_loop->recorder.width),
          "rows: an array with a column per recorded number is needed");
  loop.rows = nb::cast(rows);
  loop.step_loop->record(instants, rows.data(), static_cast<Eigen::Index>(rows.shape(0)));
}

Stop advance(Loop& loop, double until, bool final, double pause, double budget) {
  Stop stop;
  {
    nb::gil_scoped_release released;
    stop = loop.step_loop->advance(until, final, pause, budget);
  }
  if (stop.reason == Stop::exception) {
    loop.step_loop->control->failure = {};
    std::rethrow_exception(std::exchange(loop.view->raised, nullptr));
  }
  return stop;
}

bool set_control(Loop& loop, nb::handle u, bool torques) {
  Vector constant(torques ? loop.step_loop->control->tau.size() : loop.core->d);
  require(read(u, constant), "u: an array of d doubles is needed, or of one for each motor");
  if (!finite(constant)) return false;
  loop.step_loop->set_control(constant, torques);
  return true;
}

void set_wrench(Loop& loop, size_t force, VectorArg wrench) {
  const BodyForces* forces = loop.step_loop->system->forces();
  require(forces && static_cast<Eigen::Index>(6 * force) < forces->wrenches.size(), "force: no such force");
  require(wrench, 6, "wrench");
  require(loop.step_loop->set_wrench(force, wrench), "force: it is not constant");
}

bool move_desired(Loop& loop, double end, VectorArg x) {
  require(x, loop.core->d, "x"), require(end > loop.step_loop->t(), "end: a later time is needed");
  return loop.step_loop->move_desired(end, x);
}

// Return the motor torques at the present state, projected; None if there are none.
nb::object torques(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  System& system = *step_loop.system;
  Control& control = *step_loop.control;
  bool exist = step_loop.sync_core();
  if (exist) loop.core->set_velocity(system.v_tree);
  exist = exist && system.compute_control(step_loop.t());
  Vector tau = control.tau;
  exist = exist && (system.prescribed_joints().empty() || system.set_prescribed_torques(step_loop.t(), tau));
  if (exist) return nb::cast(tau);
  control.failure = {}, system.failure = RhsFailure::none;
  if (loop.view->raised) std::rethrow_exception(std::exchange(loop.view->raised, nullptr));
  return nb::none();
}

// Return the present state, projected; None if that fails.
nb::object state(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  if (!step_loop.sync_core()) return nb::none();
  System& system = *step_loop.system;
  const Vector* parts[] = {&loop.core->q_tree, &system.velocity, &system.v_tree, &system.w};
  size_t size = 0;
  for (const Vector* x : parts) size += x->size();
  double* place;
  nb::object numbers = array(size, place);
  for (const Vector* x : parts) place = std::copy(x->data(), x->data() + x->size(), place);
  loop.partition_lists.update(*loop.core);
  return nb::make_tuple(step_loop.t(), numbers, loop.partition_lists.q, loop.partition_lists.z);
}

// Hold u or torques, unless u is None, and advance. Return the stop and the state, which is None at a pause; None if a
// number is not finite.
nb::object step(Loop& loop, nb::handle u, double until, double pause, bool torques) {
  if (!u.is_none() && !set_control(loop, u, torques)) return nb::none();
  const Stop stop = advance(loop, until, false, pause, std::numeric_limits<double>::infinity());
  // At a pause, projecting the state would change the initial guesses of the following steps.
  return nb::make_tuple(stop, stop.reason == Stop::pause ? nb::none() : state(loop));
}

// Explain why no step could be made.
StepFailure failure(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  StepFailure failure{step_loop.system->failure,
                      step_loop.control->failure.message,
                      step_loop.control->failure.u,
                      std::nan(""),
                      std::nan(""),
                      {},
                      {},
                      {}};
  if (step_loop.sync_core()) {
    if (step_loop.control->needs_fixed_partition() || std::isfinite(step_loop.system->coordinate_margin()))
      failure.margin = step_loop.system->phi_z_margin();
    failure.sigma_min = failure.margin * loop.core->constraints.J().norm();
  }
  failure.q_tree = loop.core->q_tree, failure.q = loop.core->q, failure.z = loop.core->z;
  return failure;
}

LoopStats stats(const Loop& loop) {
  const StepLoop& step_loop = *loop.step_loop;
  const Counts& counts = step_loop.system->counts;
  const Work& work = step_loop.work;
  const bool compiled = loop.core->compiled != nullptr;
  LoopStats stats{};
  for (int k = 0; k < 3; ++k) {
    stats.steps += step_loop.steps[k];
    if (step_loop.steps[k]) stats.steps_by_method[method_names[k]] = step_loop.steps[k];
  }
  stats.terms = compiled ? "generated" : "pinocchio";
  if (compiled) stats.rhs_by_terms["generated"] = work.rhs - loop.rhs_before_compiled - counts.general_rhs;
  if (counts.general_rhs) stats.rhs_by_terms["general"] = counts.general_rhs;
  if (loop.rhs_before_compiled || !compiled)
    stats.rhs_by_terms["pinocchio"] = compiled ? loop.rhs_before_compiled : work.rhs;
  stats.rhs = work.rhs, stats.rejected = work.rejected, stats.jacobians = work.jacobians;
  stats.newton = counts.newton, stats.factorizations = counts.factorizations + work.factorizations;
  stats.differences = counts.differences, stats.switches = counts.switches;
  stats.method = step_loop.method() ? step_loop.method()->name() : "";
  stats.python_calls = loop.view->calls;
  return stats;
}

// Return the locked joints with their holding forces and bounds.
std::vector<LockedJoint> locked_joints(const Loop& loop) {
  std::vector<LockedJoint> locked;
  const Joints& joints = loop.core->joints;
  for (size_t i = 0; i < joints.locked.size() && static_cast<Eigen::Index>(i) < joints.holding_forces().size(); ++i) {
    const int k = joints.locked[i];
    const double force = joints.holding_forces()(static_cast<Eigen::Index>(i));
    locked.push_back({k, force, joints.lower_force(k), joints.upper_force(k)});
  }
  return locked;
}

nb::typed<nb::dict, nb::str, nb::typed<nb::tuple, int, double>> profile(const Loop& loop) {
  nb::typed<nb::dict, nb::str, nb::typed<nb::tuple, int, double>> by_term;
  const Profile& profile = loop.core->profile;
  for (int k = 0; k < Profile::terms; ++k)
    if (profile.calls[k]) by_term[Profile::names[k]] = nb::make_tuple(profile.calls[k], profile.seconds[k]);
  return by_term;
}

// Return y' at (t, y); for tests and timings.
nb::object rhs(Loop& loop, double t, VectorArg y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  Vector y_dot(system.size);
  return system.rhs(t, y, y_dot) ? nb::cast(y_dot) : nb::none();
}

nb::object jacobian(Loop& loop, double t, VectorArg y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  Matrix by_y;
  long evaluations = 0;
  return system.jacobian(t, y, by_y, evaluations) ? nb::cast(by_y) : nb::none();
}

// Return the mean time of a right-hand side (or Jacobian) over states, rows of (t, y), s: minimum of several rounds.
double seconds(Loop& loop, MatrixArg states, int rounds, bool of_jacobian) {
  System& system = *loop.step_loop->system;
  require(states.cols() == 1 + system.size && states.rows() > 0 && rounds > 0, "states: rows of (t, y) are needed");
  const Matrix columns = states.transpose();
  Vector y_dot(system.size);
  Matrix by_y;
  long evaluations = 0;
  double shortest = std::numeric_limits<double>::infinity();
  nb::gil_scoped_release released;
  for (int round = 0; round < rounds; ++round) {
    const auto start = std::chrono::steady_clock::now();
    bool exists = true;
    for (Eigen::Index k = 0; k < columns.cols(); ++k) {
      const auto y = columns.col(k).tail(system.size);
      exists = exists && (of_jacobian ? system.jacobian(columns(0, k), y, by_y, evaluations)
                                      : system.rhs(columns(0, k), y, y_dot));
    }
    require(exists, "states: no right-hand side there");
    shortest = std::min(shortest, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return shortest / static_cast<double>(columns.cols());
}

}  // namespace

void bind_loop(nb::module_& m) {
  nb::class_<View>(m, "View", "The state of the loop during a callback.")
      .def_prop_ro(
          "law_state", [](const View& view) { return view.law_state; }, "State of the control law.")
      .def("term", &View::term, "stamp"_a, "name"_a, nb::sig("def term(self, stamp: int, name: str) -> typing.Any"));
  bind_types(m), bind_allocation(m);
  nb::class_<Loop> binding(m, "Loop", "The step loop of a mechanism with its controller, events and record.");
  binding
      .def("__init__", &construct, "core"_a, "formulation"_a, "control"_a, "solver"_a, "events"_a,
           nb::sig("def __init__(self, core: dict[str, typing.Any], formulation: dict[str, typing.Any], "
                   "control: dict[str, typing.Any], solver: dict[str, typing.Any], events: list[Event]) -> None"))
      .def("start", &start, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a, "Start at a state with phi = w.")
      .def("advance", &advance, "until"_a, nb::kw_only(), "final"_a, "pause"_a, "budget"_a,
           "Advance to a time. `final`: the motion ends there; `pause`, `budget`: seconds until the loop returns.")
      .def("set_wrench", &set_wrench, "force"_a, "wrench"_a, "Apply another constant wrench from now on.")
      .def("move_desired", &move_desired, "end"_a, "x"_a,
           "Move the controller's desired q to x until `end`. False if it has none that can be replaced.")
      .def("torques", &torques, nb::sig("def torques(self) -> numpy.typing.NDArray[numpy.float64] | None"),
           "Return the motor torques at the present state; None if there are none.")
      .def("step", &step, "u"_a.none(), "until"_a, "pause"_a, nb::kw_only(), "torques"_a,
           nb::sig("def step(self, u: numpy.typing.NDArray[numpy.float64] | None, until: float, pause: float, *, "
                   "torques: bool) -> tuple[Stop, tuple[float, numpy.typing.NDArray[numpy.float64], list[int], "
                   "list[int]] | None] | None"),
           "Hold u, or motor torques, and advance; with None the controller acts. Return the stop and `state` (None at a pause); None if a number is "
           "not finite.")
      .def("state", &state,
           nb::sig("def state(self) -> tuple[float, numpy.typing.NDArray[numpy.float64], list[int], list[int]] | None"),
           "Return t, the numbers (q', velocity, v' of the terms, w), q and z of the present state; None if it cannot "
           "be projected.")
      .def("record", &record, "instants"_a, "rows"_a, "Record the state at these instants into the rows of an array.")
      .def(
          "record_now", [](Loop& loop) { return loop.step_loop->record_now(); },
          "Record the present state. False if it cannot be evaluated.")
      .def("use_compiled_terms", &use_compiled_terms, "library"_a,
           nb::sig("def use_compiled_terms(self, library: tuple[str, numpy.typing.NDArray[numpy.float64]]) -> None"),
           "Use compiled terms from here on: (path, parameters).")
      .def(
          "pause_at", [](Loop& loop, long rhs) { loop.step_loop->pause_at = rhs; }, "rhs"_a,
          "Let `advance` pause after this many right-hand sides.")
      .def("failure", &failure, "Explain why no step could be made.")
      .def("stats", &stats)
      .def(
          "occurrences", [](const Loop& loop) { return loop.step_loop->events.occurrences; },
          "Return the events that have occurred.")
      .def(
          "joint_transitions", [](const Loop& loop) { return loop.core->joints.transitions; },
          "Return the transitions of joint modes.")
      .def("locked_joints", &locked_joints, "Return the locked joints.")
      .def(
          "clear_events",
          [](Loop& loop) { loop.step_loop->events.occurrences.clear(), loop.core->joints.transitions.clear(); },
          "Forget the events and transitions so far.")
      .def(
          "crossings", [](const Loop& loop) { return loop.step_loop->crossings; }, "Times at which J lost rank.")
      .def("profile", &profile, "Return evaluations and seconds by term.")
      .def("rhs", &rhs, "t"_a, "y"_a,
           nb::sig("def rhs(self, t: float, y: numpy.typing.NDArray[numpy.float64]) -> "
                   "numpy.typing.NDArray[numpy.float64] | None"),
           "Return y' at (t, y), including control and friction; None if it does not exist.")
      .def("jacobian", &jacobian, "t"_a, "y"_a,
           nb::sig("def jacobian(self, t: float, y: numpy.typing.NDArray[numpy.float64]) -> "
                   "numpy.typing.NDArray[numpy.float64] | None"))
      .def("seconds", &seconds, "states"_a, "rounds"_a, nb::kw_only(), "of_jacobian"_a = false,
           "Return the seconds of a right-hand side, or of its Jacobian, over states: rows of (t, y).")
      .def_prop_ro("t", [](const Loop& loop) { return loop.step_loop->t(); })
      .def_prop_ro("y", [](const Loop& loop) { return Vector(loop.step_loop->y()); })
      .def_prop_ro(
          "filled", [](const Loop& loop) { return loop.step_loop->recorder.filled; }, "recorded rows")
      .def_prop_ro(
          "width", [](const Loop& loop) { return loop.step_loop->recorder.width; }, "numbers per row")
      .def_prop_ro(
          "record_columns", [](const Loop& loop) { return loop.step_loop->recorder.columns; },
          "where each quantity is in a row");
  bind_parts(m, binding);
  bind_sensitivities(binding);
}

}  // namespace ckc
