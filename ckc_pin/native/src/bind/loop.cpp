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

const char* const stop_reasons[] = {"end",      "event",  "pause",   "rhs_budget", "wall_budget", "pace",
                                    "min_step", "step",   "rank",    "chart",      "energy",      "control",
                                    "function", "output", "chatter", "contact",    "beyond_stop", "raised"};

namespace {

using RecordArray = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr const char* transition_kinds[] = {"sticks", "slides", "touches", "leaves", "bounces"};
constexpr const char* rhs_failures[] = {"none", "open", "rank", "infinite", "control", "vague", "shares", "pole"};
constexpr const char* method_names[] = {"DOP853", "RK45", "Radau"};

// Build the formulation, extended by sensitivities if its table has them; `sensitivities` then receives their results.
template <class Formulation, class... Arguments>
std::unique_ptr<System> with_sensitivities(const nb::dict& table, SensitivityResults*& sensitivities,
                                           Arguments&&... arguments) {
  if (!table.contains("variation")) return std::make_unique<Formulation>(std::forward<Arguments>(arguments)...);
  auto system = std::make_unique<SensitivitySystem<Formulation>>(
      sensitivity_table(nb::cast<nb::dict>(table["variation"])), std::forward<Arguments>(arguments)...);
  sensitivities = system.get();
  return system;
}

std::unique_ptr<System> system_from_table(Core& core, Control& control, const nb::dict& table,
                                          SensitivityResults*& sensitivities) {
  const auto kind = get<std::string>(table, "kind");
  const double tolerance = get<double>(table, "tolerance");
  require(tolerance > 0, "tolerance: a positive number is needed");
  if (kind == "dae") {
    const double alpha = get<double>(table, "alpha"), beta = get<double>(table, "beta");
    require(alpha >= 0 && beta >= 0, "alpha and beta: numbers that are not negative are needed");
    const bool projects = get<bool>(table, "projects");
    require(!table.contains("variation") || (projects && alpha == 0 && beta == 0),
            "sensitivities: the DAE must be projected onto the constraint manifold");
    return with_sensitivities<Dae>(table, sensitivities, core, control, tolerance, projects, alpha, beta);
  }
  const double epsilon = get<double>(table, "epsilon");
  const bool actual = get<bool>(table, "actual");
  require(epsilon > 0, "epsilon: a positive number is needed");
  if (kind == "level_set")
    return with_sensitivities<LevelSet>(table, sensitivities, core, control, epsilon, actual, tolerance,
                                        get<double>(table, "slack"));
  require(kind == "printed", "formulation: dae, level_set or printed");
  require(core.tree.roots.empty(), "eq. 8 as printed: trees with free roots are not supported");
  return std::make_unique<PrintedSpf>(core, control, epsilon, actual);
}

// (of, coordinate, value, sign, direction, stop, floor, function or None)
Event event_from_row(const nb::tuple& row, const Core& core, const std::shared_ptr<View>& view) {
  const int of = nb::cast<int>(row[0]), coordinate = nb::cast<int>(row[1]);
  require(of >= Event::q && of <= Event::function, "event: of what?");
  require_indices({coordinate}, core.n, "event");
  Event event{static_cast<Event::Quantity>(of),
              coordinate,
              nb::cast<double>(row[2]),
              nb::cast<double>(row[3]),
              nb::cast<int>(row[4]),
              nb::cast<bool>(row[5]),
              nb::cast<double>(row[6]),
              {}};
  if (event.quantity != Event::function) return event;
  auto function = std::make_shared<nb::object>(row[7]);
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
  auto acting = control_from_table(control, *loop.core, loop.view);
  auto system = system_from_table(*loop.core, *acting, formulation, loop.sensitivities);
  const Options options{get<std::string>(solver, "method"), get<double>(solver, "rtol"),
                        get<double>(solver, "atol"),        get<double>(solver, "max_step"),
                        get<double>(solver, "min_step"),    get<long>(solver, "max_rhs"),
                        get<double>(solver, "closed")};
  require(options.rtol > 0 && options.atol > 0 && options.max_step > 0, "tolerances must be positive");
  std::vector<Event> functions;
  for (const auto& row : events) functions.push_back(event_from_row(nb::cast<nb::tuple>(row), *loop.core, loop.view));
  loop.core->profile.on = get<bool>(solver, "profile");
  loop.step_loop = std::make_unique<StepLoop>(std::move(acting), std::move(system), options, std::move(functions));
}

namespace {

void construct(Loop* self, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
               const nb::dict& solver, const nb::list& events) {
  new (self) Loop;
  prepare(*self, core, formulation, control, solver, events);
}

void start(Loop& loop, double t, Given q_tree, Given v_tree, Given w) {
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

void record(Loop& loop, Given instants, RecordArray rows) {
  require(instants, instants.size(), "instants");
  require(rows.shape(1) == static_cast<size_t>(loop.step_loop->recorder.width), "rows: another width");
  loop.rows = nb::cast(rows);
  loop.step_loop->record(instants, rows.data(), static_cast<Eigen::Index>(rows.shape(0)));
}

// (why, t, value, event, filled rows)
nb::object advance(Loop& loop, double until, bool final, double pause, double budget) {
  Stop stop;
  {
    nb::gil_scoped_release released;
    stop = loop.step_loop->advance(until, final, pause, budget);
  }
  if (stop.reason == Stop::exception) {
    loop.step_loop->control->failure = {};
    std::rethrow_exception(std::exchange(loop.view->raised, nullptr));
  }
  return nb::make_tuple(stop_reasons[stop.reason], stop.t, stop.value, stop.which, loop.step_loop->recorder.filled);
}

bool set_control(Loop& loop, nb::handle u, bool of_motors) {
  Vector constant(of_motors ? loop.step_loop->control->tau.size() : loop.core->d);
  require(read(u, constant), "u: an array of d doubles is needed, or of one for each motor");
  if (!finite(constant)) return false;
  loop.step_loop->set_control(constant, of_motors);
  return true;
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

// Hold u or torques and advance. Return the stop and the state; None if a number is not finite.
nb::object step(Loop& loop, nb::handle u, bool of_motors, double until, double pause) {
  if (!set_control(loop, u, of_motors)) return nb::none();
  nb::object stop = advance(loop, until, false, pause, std::numeric_limits<double>::infinity());
  return nb::make_tuple(std::move(stop), state(loop));
}

// Explain why no step could be made.
nb::tuple failure(Loop& loop) {
  StepLoop& step_loop = *loop.step_loop;
  const ControlFailure& failure = step_loop.control->failure;
  const std::string why = rhs_failures[static_cast<int>(step_loop.system->failure)], says = failure.message;
  const Vector u = failure.u;
  const bool is_known = step_loop.sync_core(),
             of_q = step_loop.control->needs_fixed_partition() || std::isfinite(step_loop.system->coordinate_margin());
  const double margin = is_known && of_q ? step_loop.system->phi_z_margin() : std::nan("");
  const double size = is_known ? loop.core->constraints.J.norm() : std::nan("");
  return nb::make_tuple(why, says, u, margin * size, margin, Vector(loop.core->q_tree), loop.core->q, loop.core->z);
}

nb::dict stats(const Loop& loop) {
  const StepLoop& step_loop = *loop.step_loop;
  const Counts& counts = step_loop.system->counts;
  nb::dict found, by_method, by_terms;
  long steps = 0;
  for (int k = 0; k < 3; ++k) {
    steps += step_loop.steps[k];
    if (step_loop.steps[k]) by_method[method_names[k]] = step_loop.steps[k];
  }
  found["terms"] = loop.core->compiled ? "generated" : "pinocchio";
  if (loop.core->compiled) by_terms["generated"] = step_loop.work.rhs - loop.rhs_before_compiled - counts.general_rhs;
  if (counts.general_rhs) by_terms["general"] = counts.general_rhs;
  if (loop.rhs_before_compiled || !loop.core->compiled)
    by_terms["pinocchio"] = loop.core->compiled ? loop.rhs_before_compiled : step_loop.work.rhs;
  found["rhs_by_terms"] = by_terms;
  found["rhs"] = step_loop.work.rhs, found["steps"] = steps, found["rejected"] = step_loop.work.rejected;
  found["newton"] = counts.newton, found["factorizations"] = counts.factorizations + step_loop.work.factorizations;
  found["jacobians"] = step_loop.work.jacobians, found["differences"] = counts.differences;
  found["switches"] = counts.switches;
  found["method"] = step_loop.method() ? step_loop.method()->name() : "";
  found["steps_by_method"] = by_method, found["python_calls"] = loop.view->calls;
  return found;
}

nb::list occurrences(const Loop& loop) {
  nb::list found;
  for (const EventOccurrence& occurrence : loop.step_loop->events.occurrences)
    found.append(nb::make_tuple(occurrence.t, occurrence.event, occurrence.direction));
  return found;
}

// Return the transitions of joint modes so far.
nb::list joint_transitions(const Loop& loop) {
  nb::list found;
  for (const JointTransition& transition : loop.core->joints.transitions)
    found.append(
        nb::make_tuple(transition.t, transition.coordinate, transition_kinds[transition.kind], transition.direction));
  return found;
}

// Return the locked joints with their holding forces and bounds.
nb::list locked_joints(const Loop& loop) {
  nb::list locked;
  const Joints& joints = loop.core->joints;
  for (size_t i = 0; i < joints.locked.size() && static_cast<Eigen::Index>(i) < joints.holding_forces().size(); ++i) {
    const int k = joints.locked[i];
    locked.append(nb::make_tuple(k, joints.holding_forces()(static_cast<Eigen::Index>(i)), joints.lower_force(k),
                                 joints.upper_force(k)));
  }
  return locked;
}

nb::dict profile(const Loop& loop) {
  nb::dict found;
  const Profile& profile = loop.core->profile;
  for (int k = 0; k < Profile::terms; ++k)
    if (profile.calls[k]) found[Profile::names[k]] = nb::make_tuple(profile.calls[k], profile.seconds[k]);
  return found;
}

// Return y' at (t, y); for tests and timings.
nb::object rhs(Loop& loop, double t, Given y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  Vector y_dot(system.size);
  return system.rhs(t, y, y_dot) ? nb::cast(y_dot) : nb::none();
}

nb::object jacobian(Loop& loop, double t, Given y) {
  System& system = *loop.step_loop->system;
  require(y, system.size, "y");
  Matrix found;
  long evaluations = 0;
  return system.jacobian(t, y, found, evaluations) ? nb::cast(found) : nb::none();
}

// Seconds of a right-hand side (or Jacobian) over states, rows of (t, y), minimum of several rounds.
double seconds(Loop& loop, Table states, int rounds, bool of_jacobian) {
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
    for (Eigen::Index k = 0; k < columns.cols(); ++k) {
      const auto y = columns.col(k).tail(system.size);
      const bool exists =
          of_jacobian ? system.jacobian(columns(0, k), y, by_y, evaluations) : system.rhs(columns(0, k), y, y_dot);
      require(exists, "states: no right-hand side there");
    }
    shortest = std::min(shortest, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return shortest / static_cast<double>(columns.cols());
}

}  // namespace

void bind_loop(nb::module_& m) {
  nb::class_<View>(m, "View").def("term", &View::term, "stamp"_a, "name"_a);
  nb::class_<Loop> binding(m, "Loop");
  binding.def("__init__", &construct, "core"_a, "formulation"_a, "control"_a, "solver"_a, "events"_a)
      .def("start", &start, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a)
      .def("step", &step, "u"_a, "of_motors"_a, "until"_a, "pause"_a)
      .def("record", &record, "instants"_a, "rows"_a)
      .def("record_now", [](Loop& loop) { loop.step_loop->record_now(); })
      .def("write", &use_compiled_terms, "library"_a)
      .def(
          "pause_at", [](Loop& loop, long rhs) { loop.step_loop->pause_at = rhs; }, "rhs"_a)
      .def("advance", &advance, "until"_a, "final"_a, "pause"_a, "budget"_a)
      .def("state", &state)
      .def("trouble", &failure)
      .def("stats", &stats)
      .def("met", &occurrences)
      .def("joint_changes", &joint_transitions)
      .def("locked_joints", &locked_joints)
      .def("forget_met",
           [](Loop& loop) { loop.step_loop->events.occurrences.clear(), loop.core->joints.transitions.clear(); })
      .def("crossings", [](const Loop& loop) { return loop.step_loop->crossings; })
      .def("profile", &profile)
      .def("rhs", &rhs, "t"_a, "y"_a)
      .def("jacobian", &jacobian, "t"_a, "y"_a)
      .def("seconds", &seconds, "states"_a, "rounds"_a, "of_jacobian"_a = false)
      .def_prop_ro("t", [](const Loop& loop) { return loop.step_loop->t(); })
      .def_prop_ro("y", [](const Loop& loop) { return Vector(loop.step_loop->y()); })
      .def_prop_ro("filled", [](const Loop& loop) { return loop.step_loop->recorder.filled; })
      .def_prop_ro("width", [](const Loop& loop) { return loop.step_loop->recorder.width; });
  bind_parts(m, binding);
  bind_sensitivities(binding);
}

}  // namespace ckc
