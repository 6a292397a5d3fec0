// What acts on a mechanism, from Python's tables; and a caller's own functions, which get the terms that the loop has.
#include <algorithm>
#include <limits>

#include <nanobind/stl/shared_ptr.h>

#include "bind/control.hpp"

namespace ckc {

namespace {

std::unique_ptr<Motion> motion_of(const nb::dict& table, int size) {
  const auto kind = get<std::string>(table, "kind");
  if (kind == "harmonics") {
    const auto amplitude = get<Matrix>(table, "amplitude"), frequency = get<Matrix>(table, "frequency"),
               phase = get<Matrix>(table, "phase");
    const auto offset = get<Vector>(table, "offset");
    require(offset, size, "offset");
    for (const Matrix* m : {&amplitude, &frequency, &phase})
      require(m->rows() == size && m->cols() == amplitude.cols() && m->allFinite(), "harmonics: finite rows are needed");
    return std::make_unique<Harmonics>(offset, amplitude, frequency, phase);
  }
  if (kind == "spline") {
    const auto breaks = get<Vector>(table, "breaks");
    const auto coefficients = get<std::vector<Matrix>>(table, "coefficients");
    require(breaks.size() > 1, "spline: at least two breaks are needed"), require(breaks, breaks.size(), "breaks");
    for (const Matrix& c : coefficients)
      require(c.rows() == breaks.size() - 1 && c.cols() == size && c.allFinite(), "spline: a row of coefficients a piece");
    return std::make_unique<Spline>(breaks, coefficients);
  }
  require(kind == "point", "desired: harmonics, spline or point");
  PointMotion::Task task{closure_of(get<nb::dict>(table, "closure")), get<Indices>(table, "psi"),
                         get<Indices>(table, "axis"), get<Vector>(table, "level")};
  const auto n = task.psi.size();
  require(task.axis.size() == n && task.level.size() == static_cast<Eigen::Index>(n), "point: rows of one length");
  require_indices(task.psi, task.closure.rows, "psi");
  const auto knots = get<Matrix>(table, "knots");
  const auto times = get<Vector>(table, "times");
  require(knots.cols() == times.size() && times.size() > 1 && knots.allFinite(), "knots: a column a time is needed");
  return std::make_unique<PointMotion>(model_of(table), get<Indices>(table, "place"), std::move(task),
                                       motion_of(get<nb::dict>(table, "path"), 3), get<Indices>(table, "q"), times,
                                       knots, get<double>(table, "tolerance"), get<double>(table, "end"),
                                       get<std::string>(table, "past_end"));
}

// A caller's own, which gives u as an array of d doubles, or torques, or a string that says why there is none.
class Caller : public Controller {
 public:
  // `differs`: how u changes with the state is found by differences; else that is not known.
  Caller(nb::object function, bool of_motors, bool differs, std::shared_ptr<View> view)
      : function_(std::move(function)), of_motors_(of_motors), differs_(differs), view_(std::move(view)) {}
  ~Caller() override {
    nb::gil_scoped_acquire acquired;
    function_.reset();
  }

  bool u(const Measured& at, Out u, Problem& problem) override {
    nb::gil_scoped_acquire acquired;
    nb::object answer;
    t_ = at.t, v_ = at.v_tree;
    if (!view_->call(function_, at, problem, answer)) return false;
    if (read(answer, u)) return true;
    problem.says = nb::cast<std::string>(answer);
    return false;
  }
  bool of_motors() const override { return of_motors_; }

  // By central differences along each coordinate and each rate of the tree, whether the loops allow it or not.
  bool slopes(Core& core, const Indices& own, Matrix& by_q, Matrix& by_v) override {
    if (!differs_) return false;
    const Vector here = core.q_tree, v = v_;
    const auto d = static_cast<Eigen::Index>(own.size());
    Vector step = Vector::Zero(core.n), there, rates, q(d), q_dot(d), u_there(d);
    Problem problem;
    bool known = true;
    const auto add = [&](int k, bool of_rate, double by, Matrix& slope) {
      there = here, rates = v;
      step(k) = by;
      if (of_rate) rates += step;
      else core.tree.integrate(there, step);
      step(k) = 0.0;
      core.set(there);
      for (Eigen::Index i = 0; i < d; ++i) q(i) = there(core.tree.place[own[i]]), q_dot(i) = rates(own[i]);
      known = known && u({t_, core, q, q_dot, rates, q_dot}, u_there, problem);
      slope.col(k) += u_there / (2.0 * by);
    };
    for (int k = 0; k < core.n; ++k)
      for (const double by : {difference, -difference}) add(k, false, by, by_q), add(k, true, by, by_v);
    if (problem.raised) view_->raised = nullptr;
    core.set(here), core.set_velocity(v);
    v_ = v;
    return known && by_q.allFinite() && by_v.allFinite();
  }

 private:
  static constexpr double difference = 6e-6;  // rad, m, rad/s, m/s: the third root of rounding
  nb::object function_;
  const bool of_motors_, differs_;
  double t_ = 0.0;  // of the last u
  Vector v_;
  std::shared_ptr<View> view_;
};

}  // namespace

std::unique_ptr<Controller> law_of(const nb::dict& table, const Core& core, Eigen::Index motors,
                                   const std::shared_ptr<View>& view) {
  const auto kind = get<std::string>(table, "kind");
  if (kind == "call") return std::make_unique<Caller>(nb::object(table["function"]), get<bool>(table, "of_motors"), get<bool>(table, "differs"), view);
  if (kind == "torques") {
    const auto times = get<Vector>(table, "times");
    const auto tau = get<Matrix>(table, "tau");
    require(times.size() > 0 && times.allFinite(), "torques: a time is needed");
    require(tau.cols() == times.size() && tau.rows() == motors && tau.allFinite(), "torques: a finite column a time");
    return std::make_unique<Torques>(times, tau, get<bool>(table, "lines"));
  }
  const int d = core.d;
  if (kind == "set_point") {
    const auto K_P = get<Matrix>(table, "K_P"), K_V = get<Matrix>(table, "K_V");
    const auto q_d = get<Vector>(table, "q_d"), h_d = get<Vector>(table, "h_d");
    require_square(K_P, d, "K_P"), require_square(K_V, d, "K_V"), require(q_d, d, "q_d"), require(h_d, d, "h_d");
    return std::make_unique<SetPoint>(K_P, K_V, q_d, h_d, get<double>(table, "potential"));
  }
  require(kind == "tracking", "controller: set_point, tracking, torques or call");
  const auto Lambda = get<Matrix>(table, "Lambda"), K_D = get<Matrix>(table, "K_D");
  require_square(Lambda, d, "Lambda"), require_square(K_D, d, "K_D");
  std::unique_ptr<Core> model;
  if (table.contains("model")) model = core_of(get<nb::dict>(table, "model"));
  require(!model || (model->n == core.n && model->q == core.q), "model: another partition than the plant's");
  return std::make_unique<Tracking>(Lambda, K_D, motion_of(get<nb::dict>(table, "desired"), d), std::move(model),
                                    get<bool>(table, "actual"));
}

// Its arguments: (view, stamp, t, the numbers of `put`, q, z). Arrays are made once, and filled for each call.
bool View::call(const nb::object& function, const Measured& at, Problem& problem, nb::object& answer) {
  nb::gil_scoped_acquire acquired;
  ++calls;
  seen_ = &at;
  ++stamp_;
  put(at);
  bool returned = true;
  try {
    answer = function(nb::cast(shared_from_this()), stamp_, at.t, numbers_, places_.q, places_.z);
  } catch (...) {
    raised = std::current_exception();
    problem.raised = true;
    returned = false;
  }
  seen_ = nullptr;
  return returned;
}

// q', v', q, q_dot, one after the other.
void View::put(const Measured& at) {
  const Core& core = at.core;
  const size_t size = core.q_tree.size() + core.n + 2 * core.d;
  if (!data_) numbers_ = array(size, data_);
  places_.are(core);
  double* place = data_;
  for (const Vector* x : {&core.q_tree, &at.v_tree, &at.q, &at.q_dot})
    place = std::copy(x->data(), x->data() + x->size(), place);
}

nb::object View::term(long stamp, const std::string& name) {
  asked = true;
  if (!seen_ || stamp != stamp_) return nb::none();
  seen_->core.set_velocity(seen_->v_tree);
  return term_of(seen_->core, name);
}

namespace {

Actuation actuation_of(const nb::dict& table, const Core& core) {
  const auto turns = get<Matrix>(table, "turns");
  const auto limit = get<Vector>(table, "limit"), weights = get<Vector>(table, "weights"),
             preload = get<Vector>(table, "preload");
  const auto m = turns.rows();
  require(turns.cols() == core.n && turns.allFinite(), "turns: a finite column a coordinate is needed");
  require(limit.size() == m && (limit.array() >= 0).all(), "limit: a positive number each");
  require(weights, m, "weights"), require(preload, m, "preload");
  require((weights.array() > 0).all(), "weights: a positive number each");
  std::vector<std::vector<Actuation::Gear>> gears(m);
  for (Eigen::Index k = 0; k < m; ++k)
    for (int j = 0; j < core.n; ++j)
      if (turns(k, j) != 0.0) gears[k].push_back({j, turns(k, j)});
  return {core, std::move(gears), get<bool>(table, "direct"),
          Allocation(static_cast<int>(m), core.d, limit, weights, preload)};
}

Sensor sensor_of(const nb::dict& table, const Core& core) {
  Sensor sensor;
  sensor.resolution = get<Vector>(table, "resolution");
  sensor.q_noise = get<Vector>(table, "q_noise"), sensor.q_dot_noise = get<Vector>(table, "q_dot_noise");
  require(sensor.resolution, core.d, "resolution");
  require(sensor.q_noise, core.d, "q_noise"), require(sensor.q_dot_noise, core.d, "q_dot_noise");
  sensor.differences = get<bool>(table, "differences"), sensor.smoothing = get<double>(table, "smoothing");
  sensor.seed = get<std::uint64_t>(table, "seed");
  if (table.contains("observer")) sensor.observer = core_of(get<nb::dict>(table, "observer"));
  return sensor;
}

}  // namespace

std::unique_ptr<Control> control_of(const nb::dict& table, const Core& core, const std::shared_ptr<View>& view) {
  auto control = std::make_unique<Control>(core, actuation_of(table, core));
  const auto motors = control->tau.size();
  if (table.contains("law")) control->law = law_of(get<nb::dict>(table, "law"), core, motors, view);
  if (table.contains("clock")) {
    const auto clock = get<nb::dict>(table, "clock");
    Sampling& sampling = control->sampling.emplace();
    sampling.period = get<double>(clock, "period"), sampling.delay = get<double>(clock, "delay");
    sampling.times = get<Vector>(clock, "times"), sampling.holds = get<bool>(clock, "holds");
  }
  if (table.contains("sensor")) control->sensor = sensor_of(get<nb::dict>(table, "sensor"), core);
  if (table.contains("drive")) {
    const auto drive = get<nb::dict>(table, "drive");
    control->drive = Drive{get<Vector>(drive, "resolution"), get<Vector>(drive, "rate"), Vector::Zero(motors)};
    require(control->drive->resolution, motors, "resolution");
    require(control->drive->rate.size() == motors, "rate: a number a motor is needed");
  }
  require(control->sampling || !(control->sensor || control->drive), "sensor and drive: a clock is needed");
  return control;
}

}  // namespace ckc
