// The step loop as Python sees it. It runs without the interpreter's lock, but for callers' functions.
#include <algorithm>
#include <chrono>
#include <cmath>

#include <nanobind/stl/unique_ptr.h>

#include "bind/run.hpp"
#include "loops/compiled_terms.hpp"
#include "motion/printed_spf.hpp"
#include "sensitivity/sensitivity_system.hpp"

namespace ckc {

using namespace nb::literals;

const char* const reasons[] = {"end",  "event", "pause",   "rhs_budget", "wall_budget", "pace", "min_step", "step",
                               "rank", "chart", "energy",  "control",    "function",    "output",   "chatter", "contact",
                               "beyond_stop", "raised"};

namespace {

using Rows = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr const char* changes[] = {"sticks", "slides", "touches", "leaves", "bounces"};
constexpr const char* troubles[] = {"none", "open", "rank", "infinite", "control", "vague", "shares", "pole"};
constexpr const char* methods[] = {"DOP853", "RK45", "Radau"};

std::unique_ptr<System> system_of(Core& core, Control& control, const nb::dict& table) {
  const auto kind = get<std::string>(table, "kind");
  const double tolerance = get<double>(table, "tolerance");
  require(tolerance > 0, "tolerance must be positive");
  if (kind == "dae") {
    const double alpha = get<double>(table, "alpha"), beta = get<double>(table, "beta");
    require(alpha >= 0 && beta >= 0, "alpha and beta must not be negative");
    const bool projects = get<bool>(table, "projects");
    if (table.contains("variation")) {
      require(projects && alpha == 0 && beta == 0, "variation: of a motion that is put back on the closure");
      return std::make_unique<Varied<Dae>>(variation_of(nb::cast<nb::dict>(table["variation"])), core, control, tolerance,
                                           projects, alpha, beta);
    }
    return std::make_unique<Dae>(core, control, tolerance, projects, alpha, beta);
  }
  const double epsilon = get<double>(table, "epsilon");
  const bool actual = get<bool>(table, "actual");
  require(epsilon > 0, "epsilon must be positive");
  if (kind == "level_set") {
    const double slack = get<double>(table, "slack");
    if (!table.contains("variation"))
      return std::make_unique<LevelSet>(core, control, epsilon, actual, tolerance, slack);
    return std::make_unique<Varied<LevelSet>>(variation_of(nb::cast<nb::dict>(table["variation"])), core, control, epsilon,
                                              actual, tolerance, slack);
  }
  require(kind == "printed" && core.tree.roots.empty(), "eq. 8 as printed has no free root: its place is no number");
  return std::make_unique<PrintedSpf>(core, control, epsilon, actual);
}

// (of, coordinate, value, sign, direction, stop, floor, function or None)
Event event_of(const nb::tuple& row, const Core& core, const std::shared_ptr<View>& view) {
  const int of = nb::cast<int>(row[0]), coordinate = nb::cast<int>(row[1]);
  require(of >= Event::q && of <= Event::function, "event: of what?");
  require_indices({coordinate}, core.n, "event");
  Event event{static_cast<Event::Of>(of), coordinate,           nb::cast<double>(row[2]), nb::cast<double>(row[3]),
              nb::cast<int>(row[4]),      nb::cast<bool>(row[5]), nb::cast<double>(row[6]), {}};
  if (event.of != Event::function) return event;
  auto function = std::make_shared<nb::object>(row[7]);
  event.call = [function, view](double t, System& system, double& value) {
    nb::object answer;
    Problem& problem = system.control.problem;
    if (!view->call(*function, system.measured(t), problem, answer)) return false;
    nb::gil_scoped_acquire acquired;
    if (nb::isinstance<nb::str>(answer))
      problem.says = nb::cast<std::string>(answer);
    else
      value = nb::cast<double>(answer);
    answer.reset();
    return problem.says.empty();
  };
  return event;
}

}  // namespace

void prepare(Run& run, const nb::dict& core, const nb::dict& formulation, const nb::dict& control,
             const nb::dict& solver, const nb::list& events) {
  run.core = core_of(core);
  auto acting = control_of(control, *run.core, run.view);
  auto system = system_of(*run.core, *acting, formulation);
  const Options options{get<std::string>(solver, "method"), get<double>(solver, "rtol"),   get<double>(solver, "atol"),
                        get<double>(solver, "max_step"),    get<double>(solver, "min_step"), get<long>(solver, "max_rhs"),
                        get<double>(solver, "closed")};
  require(options.rtol > 0 && options.atol > 0 && options.max_step > 0, "tolerances must be positive");
  std::vector<Event> functions;
  for (const auto& row : events) functions.push_back(event_of(nb::cast<nb::tuple>(row), *run.core, run.view));
  run.core->profile.on = get<bool>(solver, "profile");
  run.loop = std::make_unique<Loop>(std::move(acting), std::move(system), options, std::move(functions));
}

namespace {

void make(Run* self, const nb::dict& core, const nb::dict& formulation, const nb::dict& control, const nb::dict& solver,
          const nb::list& events) {
  new (self) Run;
  prepare(*self, core, formulation, control, solver, events);
}

void start(Run& run, double t, Given q_tree, Given v_tree, Given w) {
  const Core& core = *run.core;
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree"), require(w, core.rows.closure.rows, "w");
  require(std::isfinite(t), "t: a number is not finite");
  run.view->calls = 0, run.view->asked = false, run.rhs_before = 0;
  run.loop->start(t, q_tree, v_tree, w);
}

// From here on the core has terms that are written out.
void write(Run& run, const nb::tuple& library) {
  if (!run.core->written) run.rhs_before = run.loop->work.rhs;
  run.core->written = written_of(library);
  run.loop->settle_core();
}

void record(Run& run, Given instants, Rows rows) {
  require(instants, instants.size(), "instants");
  require(rows.shape(1) == static_cast<size_t>(run.loop->recorder.width), "rows: another width");
  run.rows = nb::cast(rows);
  run.loop->record(instants, rows.data(), static_cast<Eigen::Index>(rows.shape(0)));
}

// (why, t, value, event, filled rows)
nb::object advance(Run& run, double until, bool final, double pause, double budget) {
  Stop stop;
  {
    nb::gil_scoped_release released;
    stop = run.loop->advance(until, final, pause, budget);
  }
  if (stop.why == Stop::raised) {
    run.loop->control->problem = {};
    std::rethrow_exception(std::exchange(run.view->raised, nullptr));
  }
  return nb::make_tuple(reasons[stop.why], stop.t, stop.value, stop.which, run.loop->recorder.filled);
}

bool hold(Run& run, nb::handle u, bool of_motors) {
  Vector constant(of_motors ? run.loop->control->tau.size() : run.core->d);
  require(read(u, constant), "u: an array of d doubles is needed, or of one for each motor");
  if (!finite(constant)) return false;
  run.loop->hold(constant, of_motors);
  return true;
}

// The present state, closed: (t, an array of q', velocity, v' of the terms and w, q, z); none where that does not exist.
nb::object state(Run& run) {
  Loop& loop = *run.loop;
  if (!loop.settle_core()) return nb::none();
  System& system = *loop.system;
  const Vector* parts[] = {&run.core->q_tree, &system.velocity, &system.v_tree, &system.w};
  size_t size = 0;
  for (const Vector* x : parts) size += x->size();
  double* place;
  nb::object numbers = array(size, place);
  for (const Vector* x : parts) place = std::copy(x->data(), x->data() + x->size(), place);
  run.places.are(*run.core);
  return nb::make_tuple(loop.t(), numbers, run.places.q, run.places.z);
}

// Hold u, or the motors' torques, and advance: what `advance` returns, and the state there; none where not finite.
nb::object step(Run& run, nb::handle u, bool of_motors, double until, double pause) {
  if (!hold(run, u, of_motors)) return nb::none();
  nb::object stop = advance(run, until, false, pause, std::numeric_limits<double>::infinity());
  return nb::make_tuple(std::move(stop), state(run));
}

// Why no step could be made: (trouble, what a controller says, its u, phi_z's least singular value and that over |J|,
// the core's q', q, z).
nb::tuple trouble(Run& run) {
  Loop& loop = *run.loop;
  const Problem& problem = loop.control->problem;
  const std::string why = troubles[static_cast<int>(loop.system->trouble)], says = problem.says;
  const Vector u = problem.u;
  const bool here = loop.settle_core(), of_q = loop.control->needs_own_partition() || std::isfinite(loop.system->margin());
  const double margin = here && of_q ? loop.system->phi_z_margin() : std::nan("");
  const double size = here ? run.core->rows.J.norm() : std::nan("");
  return nb::make_tuple(why, says, u, margin * size, margin, Vector(run.core->q_tree), run.core->q, run.core->z);
}

nb::dict stats(const Run& run) {
  const Loop& loop = *run.loop;
  const Counts& counts = loop.system->counts;
  nb::dict found, by_method, by_terms;
  long steps = 0;
  for (int k = 0; k < 3; ++k) {
    steps += loop.steps[k];
    if (loop.steps[k]) by_method[methods[k]] = loop.steps[k];
  }
  found["terms"] = run.core->written ? "generated" : "pinocchio";
  if (run.core->written) by_terms["generated"] = loop.work.rhs - run.rhs_before - counts.pivoted;
  if (counts.pivoted) by_terms["general"] = counts.pivoted;
  if (run.rhs_before || !run.core->written) by_terms["pinocchio"] = run.core->written ? run.rhs_before : loop.work.rhs;
  found["rhs_by_terms"] = by_terms;
  found["rhs"] = loop.work.rhs, found["steps"] = steps, found["rejected"] = loop.work.rejected;
  found["newton"] = counts.newton, found["factorizations"] = counts.factorizations + loop.work.factorizations;
  found["jacobians"] = loop.work.jacobians, found["differences"] = counts.differences;
  found["switches"] = counts.switches;
  found["method"] = loop.method() ? loop.method()->name() : "";
  found["steps_by_method"] = by_method, found["python_calls"] = run.view->calls;
  return found;
}

nb::list met(const Run& run) {
  nb::list found;
  for (const Crossed& crossed : run.loop->events.met)
    found.append(nb::make_tuple(crossed.t, crossed.event, crossed.direction));
  return found;
}

// What joints did: (t, coordinate, what, direction).
nb::list joint_changes(const Run& run) {
  nb::list found;
  for (const JointChange& change : run.core->joints.changes)
    found.append(nb::make_tuple(change.t, change.coordinate, changes[change.what], change.direction));
  return found;
}

// The joints that are held: (coordinate, force, its least, its largest).
nb::list locked_joints(const Run& run) {
  nb::list locked;
  const Joints& joints = run.core->joints;
  for (size_t i = 0; i < joints.locked.size() && static_cast<Eigen::Index>(i) < joints.forces().size(); ++i) {
    const int k = joints.locked[i];
    locked.append(nb::make_tuple(k, joints.forces()(static_cast<Eigen::Index>(i)), joints.lower_force(k), joints.upper_force(k)));
  }
  return locked;
}

nb::dict profile(const Run& run) {
  nb::dict found;
  const Profile& profile = run.core->profile;
  for (int k = 0; k < Profile::terms; ++k)
    if (profile.calls[k]) found[Profile::names[k]] = nb::make_tuple(profile.calls[k], profile.seconds[k]);
  return found;
}

// y' at the present state of the system with another (q', v') put in; for tests and timings.
nb::object rhs(Run& run, double t, Given y) {
  System& system = *run.loop->system;
  require(y, system.size, "y");
  Vector y_dot(system.size);
  return system.rhs(t, y, y_dot) ? nb::cast(y_dot) : nb::none();
}

nb::object jacobian(Run& run, double t, Given y) {
  System& system = *run.loop->system;
  require(y, system.size, "y");
  Matrix found;
  long evaluations = 0;
  return system.jacobian(t, y, found, evaluations) ? nb::cast(found) : nb::none();
}

// Seconds of a right-hand side, or of its Jacobian, as the loop calls it, the least of several rounds over states: rows
// of (t, y).
double seconds(Run& run, Table states, int rounds, bool of_jacobian) {
  System& system = *run.loop->system;
  require(states.cols() == 1 + system.size && states.rows() > 0 && rounds > 0, "states: rows of (t, y) are needed");
  const Matrix columns = states.transpose();
  Vector y_dot(system.size);
  Matrix by_y;
  long evaluations = 0;
  double least = std::numeric_limits<double>::infinity();
  nb::gil_scoped_release released;
  for (int round = 0; round < rounds; ++round) {
    const auto start = std::chrono::steady_clock::now();
    for (Eigen::Index k = 0; k < columns.cols(); ++k) {
      const auto y = columns.col(k).tail(system.size);
      const bool done = of_jacobian ? system.jacobian(columns(0, k), y, by_y, evaluations) : system.rhs(columns(0, k), y, y_dot);
      require(done, "states: no right-hand side there");
    }
    least = std::min(least, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return least / static_cast<double>(columns.cols());
}

}  // namespace

void bind_loop(nb::module_& m) {
  nb::class_<View>(m, "View").def("term", &View::term, "stamp"_a, "name"_a);
  nb::class_<Run> loop(m, "Loop");
  loop.def("__init__", &make, "core"_a, "formulation"_a, "control"_a, "solver"_a, "events"_a)
      .def("start", &start, "t"_a, "q_tree"_a, "v_tree"_a, "w"_a)
      .def("step", &step, "u"_a, "of_motors"_a, "until"_a, "pause"_a)
      .def("record", &record, "instants"_a, "rows"_a)
      .def("record_now", [](Run& run) { run.loop->record_now(); })
      .def("write", &write, "library"_a)
      .def("pause_at", [](Run& run, long rhs) { run.loop->pause_at = rhs; }, "rhs"_a)
      .def("advance", &advance, "until"_a, "final"_a, "pause"_a, "budget"_a)
      .def("state", &state)
      .def("trouble", &trouble)
      .def("stats", &stats)
      .def("met", &met)
      .def("joint_changes", &joint_changes)
      .def("locked_joints", &locked_joints)
      .def("forget_met", [](Run& run) { run.loop->events.met.clear(), run.core->joints.changes.clear(); })
      .def("crossings", [](const Run& run) { return run.loop->crossings; })
      .def("profile", &profile)
      .def("rhs", &rhs, "t"_a, "y"_a)
      .def("jacobian", &jacobian, "t"_a, "y"_a)
      .def("seconds", &seconds, "states"_a, "rounds"_a, "of_jacobian"_a = false)
      .def_prop_ro("t", [](const Run& run) { return run.loop->t(); })
      .def_prop_ro("y", [](const Run& run) { return Vector(run.loop->y()); })
      .def_prop_ro("filled", [](const Run& run) { return run.loop->recorder.filled; })
      .def_prop_ro("width", [](const Run& run) { return run.loop->recorder.width; });
  bind_parts(m, loop);
  bind_variation(loop);
}

}  // namespace ckc
