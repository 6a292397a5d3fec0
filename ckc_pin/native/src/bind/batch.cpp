// Simulates the members of an ensemble: a few loops per thread, prepared once, then restarted with each member's
// parameters and initial state. The loops of a thread take their steps in turn, so that the stages of these steps can be
// computed together in the lanes of the processor's vector registers.
//
// The result of a member depends neither on the members before it nor on the number of threads. If a member stops
// early, Python repeats it to find out why.
#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>

#include "bind/run.hpp"
#include "loops/closure_solver.hpp"
#include "motion/lanes.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

using Numbers = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<std::int64_t, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t not_started = -1;
constexpr double polling_interval = 0.05;  // s, after which a thread checks whether it should stop
constexpr double after_each_attempt = -1.0;  // a pause before the first step and after each attempt of a step

struct ParameterColumns {
  Core::Parameter kind;
  Numbers numbers;  // one row per member
};

// A loop with the member that it simulates.
struct Worker {
  std::int64_t member = not_started;
  Loop loop;
  Indices q, z;
  std::unique_ptr<ClosureSolver> closure_solver;
  Matrix rows;  // one column per instant
  Vector v_tree, w;
};

// The loops of one thread.
struct Team {
  std::vector<std::unique_ptr<Worker>> workers;
  Lanes lanes;
};

// The inputs of all members, and Python's arrays for their results, one row per member.
struct EnsembleTask {
  Vector base, instants;  // q' from which the closure is solved; output instants
  Numbers q, q_dot;
  std::vector<ParameterColumns> parameter_columns;
  Indices columns;  // columns of the record that `series` contains
  double until;
  Counts stop_reason, row_count, counters;  // counters: right-hand sides, steps, rejected steps
  Numbers t, last_row, series, event_times;
  std::int64_t members;
};

void require_shape(const Numbers& x, std::initializer_list<Eigen::Index> shape, const char* what) {
  bool fits = x.ndim() == shape.size();
  size_t k = 0;
  for (Eigen::Index size : shape) fits = fits && x.shape(k++) == static_cast<size_t>(size);
  require(fits, std::string(what) + ": the array has a wrong shape");
}

class Batch {
 public:
  Batch(const Batch&) = delete;
  Batch(const nb::dict& core, const nb::dict& formulation, const nb::dict& control, const nb::dict& solver,
        const nb::list& events, double tolerance, int threads)
      : tolerance_(tolerance), events_(nb::len(events)) {
    require(threads > 0, "threads: at least one is needed");
    for (int k = 0; k < threads; ++k) {
      auto team = std::make_unique<Team>();
      do {
        team->workers.push_back(std::make_unique<Worker>());
        Worker& worker = *team->workers.back();
        prepare(worker.loop, core, formulation, control, solver, events);
        Core& worker_core = *worker.loop.core;
        require(worker_core.tree.roots.empty(), "batch: joints with one degree of freedom are needed");
        worker.q = worker_core.q, worker.z = worker_core.z;
        worker.closure_solver = std::make_unique<ClosureSolver>(worker_core);
        worker.v_tree.setZero(worker_core.n), worker.w.setZero(worker_core.constraints.closure.rows);
      } while (team->workers.size() < Lanes::width && first_loop(*team).step_loop->system->terms_of_rate());
      teams_.push_back(std::move(team));
    }
  }

  // Members whose steps a thread computes together.
  size_t lanes() const { return teams_[0]->workers.size(); }
  // Ends of steps that were computed together.
  long end_count() const {
    long count = 0;
    for (const auto& team : teams_) count += team->lanes.end_count;
    return count;
  }

  void run(VectorArg base, Numbers q, Numbers q_dot, const nb::list& parameter_columns, VectorArg instants,
           const Indices& columns, double until, const nb::dict& out) {
    const Core& core = *first_loop(*teams_[0]).core;
    EnsembleTask task{base,
                      instants,
                      q,
                      q_dot,
                      {},
                      columns,
                      until,
                      get<Counts>(out, "stop_reason"),
                      get<Counts>(out, "row_count"),
                      get<Counts>(out, "counters"),
                      get<Numbers>(out, "t"),
                      get<Numbers>(out, "last_row"),
                      get<Numbers>(out, "series"),
                      get<Numbers>(out, "event_times"),
                      static_cast<std::int64_t>(q.shape(0))};
    const Eigen::Index M = task.members, width = first_loop(*teams_[0]).step_loop->recorder.width;
    require(base, core.tree.nq, "base");
    require_shape(q, {M, core.d}, "q"), require_shape(q_dot, {M, core.d}, "q_dot");
    require_shape(task.t, {M}, "t"), require_shape(task.last_row, {M, width}, "last_row");
    require_shape(task.series, {M, static_cast<Eigen::Index>(columns.size()), instants.size()}, "series");
    require_shape(task.event_times, {M, static_cast<Eigen::Index>(events_)}, "event_times");
    for (const Counts* x : {&task.stop_reason, &task.row_count})
      require(x->size() == static_cast<size_t>(M), "out: one number per member is needed");
    require(task.counters.size() == static_cast<size_t>(3 * M), "counters: three numbers per member are needed");
    require_indices(columns, static_cast<int>(width), "columns");
    for (nb::handle row : parameter_columns) {
      const auto pair = nb::cast<nb::tuple>(row);
      const auto kind = nb::cast<Core::Parameter>(pair[0]);
      task.parameter_columns.push_back({kind, nb::cast<Numbers>(pair[1])});
      require_shape(task.parameter_columns.back().numbers, {M, core.parameter_size(kind)}, "parameters");
    }
    run_in_threads(task);
  }

 private:
  void run_in_threads(const EnsembleTask& task) {
    std::atomic<std::int64_t> next{0};
    std::atomic<bool> cancelled{false};
    std::mutex mutex;
    std::condition_variable ended;
    std::exception_ptr raised;
    size_t busy = teams_.size();
    const auto run_team = [&](Team& team) {
      try {
        simulate_members(team, task, next, cancelled);
      } catch (...) {
        std::lock_guard<std::mutex> lock(mutex);
        raised = std::current_exception(), cancelled = true;
      }
      std::lock_guard<std::mutex> lock(mutex);
      --busy;
      ended.notify_one();
    };
    bool signalled = false;
    {
      nb::gil_scoped_release released;
      std::vector<std::thread> threads;
      for (auto& team : teams_) threads.emplace_back(run_team, std::ref(*team));
      std::unique_lock<std::mutex> lock(mutex);
      while (!ended.wait_for(lock, std::chrono::duration<double>(polling_interval), [&] { return busy == 0; })) {
        lock.unlock();
        {
          nb::gil_scoped_acquire acquired;
          signalled = signalled || PyErr_CheckSignals() != 0;
        }
        if (signalled) cancelled = true;
        lock.lock();
      }
      lock.unlock();
      for (std::thread& thread : threads) thread.join();
    }
    if (signalled) throw nb::python_error();
    if (raised) std::rethrow_exception(raised);
  }

  static Loop& first_loop(Team& team) { return team.workers[0]->loop; }

  // Simulate members until there are none left.
  void simulate_members(Team& team, const EnsembleTask& task, std::atomic<std::int64_t>& next,
                        const std::atomic<bool>& cancelled) const {
    const bool has_lanes = team.workers.size() > 1;
    std::array<Explicit::Attempt, Lanes::width> attempts;
    for (bool is_running = true; is_running && !cancelled;) {
      is_running = false;
      for (size_t lane = 0; lane < team.workers.size(); ++lane) {
        Worker& worker = *team.workers[lane];
        StepLoop& step_loop = *worker.loop.step_loop;
        for (std::int64_t k; worker.member == not_started && (k = next++) < task.members;)
          if (start_member(worker, task, k)) {
            worker.member = k;
            if (!has_lanes) continue;
            team.lanes.set_constants(static_cast<int>(lane), worker.loop.core->compiled->constants());
            advance_member(worker, task, after_each_attempt, cancelled);
          }
        attempts[lane] = {};
        if (worker.member == not_started) continue;
        is_running = true;
        if (has_lanes) attempts[lane] = step_loop.prepare_explicit_step();
      }
      if (has_lanes) team.lanes.compute(attempts);
      for (auto& worker : team.workers)
        if (worker->member != not_started)
          advance_member(*worker, task, has_lanes ? after_each_attempt : polling_interval, cancelled);
    }
  }

  // Advance a worker's member up to the next pause or its end.
  void advance_member(Worker& worker, const EnsembleTask& task, double pause, const std::atomic<bool>& cancelled) const {
    const Stop stop = worker.loop.step_loop->advance(task.until, true, pause, std::numeric_limits<double>::infinity());
    if (stop.reason == Stop::pause && !cancelled) return;
    finish_member(worker, task, stop);
    worker.member = not_started;
  }

  static auto row_of(const Numbers& x, std::int64_t member, Eigen::Index size) {
    return Eigen::Map<Vector>(x.data() + member * size, size);
  }

  // False if the member cannot start.
  bool start_member(Worker& worker, const EnsembleTask& task, std::int64_t k) const {
    Core& core = *worker.loop.core;
    StepLoop& step_loop = *worker.loop.step_loop;
    task.stop_reason.data()[k] = not_started;
    for (const ParameterColumns& parameter_columns : task.parameter_columns)
      core.set_parameters(parameter_columns.kind,
                          row_of(parameter_columns.numbers, k, core.parameter_size(parameter_columns.kind)));
    core.set_partition(worker.q, worker.z);
    ClosureSolver& closure_solver = *worker.closure_solver;  // static projection: w and the initial velocity are zero
    if (!closure_solver.project(task.base, worker.w, tolerance_) ||
        !closure_solver.continue_to(row_of(task.q, k, core.d), tolerance_))
      return false;
    core.compute_rho();
    core.multiply_rho(row_of(task.q_dot, k, core.d), worker.v_tree);
    if (!worker.v_tree.allFinite()) return false;
    const Vector start = core.q_tree;
    const auto T = task.instants.size();
    worker.rows.resize(step_loop.recorder.width, T + 1);
    step_loop.start(0.0, start, worker.v_tree, worker.w);
    step_loop.record(task.instants, worker.rows.data(), T + 1);
    return true;
  }

  // Write the results of a member that has stopped.
  void finish_member(Worker& worker, const EnsembleTask& task, const Stop& stop) const {
    StepLoop& step_loop = *worker.loop.step_loop;
    const std::int64_t k = worker.member;
    const auto T = task.instants.size();
    step_loop.control->failure = {};
    task.stop_reason.data()[k] = stop.reason;
    const Eigen::Index row_count = step_loop.recorder.filled;
    task.row_count.data()[k] = row_count;
    task.t.data()[k] = step_loop.t();
    const long counters[] = {step_loop.work.rhs, step_loop.steps[0] + step_loop.steps[1] + step_loop.steps[2],
                             step_loop.work.rejected};
    std::copy(counters, counters + 3, task.counters.data() + 3 * k);
    if (!row_count) return;
    row_of(task.last_row, k, step_loop.recorder.width) = worker.rows.col(row_count - 1);
    const auto columns = static_cast<Eigen::Index>(task.columns.size());
    for (Eigen::Index j = 0; j < columns; ++j)
      for (Eigen::Index i = 0; i < std::min(row_count, T); ++i)
        if (worker.rows(0, i) == task.instants(i))
          task.series.data()[(k * columns + j) * T + i] = worker.rows(task.columns[j], i);
    for (const EventOccurrence& occurrence : step_loop.events.occurrences) {
      double& first = task.event_times.data()[k * static_cast<Eigen::Index>(events_) + occurrence.event];
      if (!(first <= occurrence.t)) first = occurrence.t;
    }
  }

  const double tolerance_;
  const size_t events_;
  std::vector<std::unique_ptr<Team>> teams_;
};

}  // namespace

void bind_batch(nb::module_& m) {
  nb::class_<Batch>(m, "Batch", "Simulates the members of an ensemble in threads.")
      .def(nb::init<const nb::dict&, const nb::dict&, const nb::dict&, const nb::dict&, const nb::list&, double, int>(),
           "core"_a, "formulation"_a, "control"_a, "solver"_a, "events"_a, nb::kw_only(), "tolerance"_a, "threads"_a,
           nb::sig("def __init__(self, core: dict[str, typing.Any], formulation: dict[str, typing.Any], "
                   "control: dict[str, typing.Any], solver: dict[str, typing.Any], events: list[Event], *, "
                   "tolerance: float, threads: int) -> None"))
      .def_prop_ro("lanes", &Batch::lanes,
                   "Members whose steps a thread computes together, in the processor's vector registers; 1 where the "
                   "compiled terms or the controller do not allow it.")
      .def_prop_ro("end_count", &Batch::end_count,
                   "Ends of steps that were computed together, including those of rejected steps.")
      .def("run", &Batch::run, "base"_a, "q"_a, "q_dot"_a, nb::kw_only(), "parameters"_a, "instants"_a, "columns"_a,
           "until"_a, "out"_a,
           nb::sig("def run(self, base: numpy.typing.NDArray[numpy.float64], q: numpy.typing.NDArray[numpy.float64], "
                   "q_dot: numpy.typing.NDArray[numpy.float64], *, parameters: list[tuple[CoreParameter, "
                   "numpy.typing.NDArray[numpy.float64]]], instants: numpy.typing.NDArray[numpy.float64], "
                   "columns: list[int], until: float, out: dict[str, numpy.typing.NDArray[typing.Any]]) -> None"),
           "Simulate members, one row each, and write the results to the arrays of `out`.");
}

}  // namespace ckc
