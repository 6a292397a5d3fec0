// Builds controllers and actuators from Python's tables, and calls the user's functions.
#include <algorithm>
#include <limits>

#include <nanobind/stl/shared_ptr.h>

#include "bind/control.hpp"
#include "control/joint_servo.hpp"

namespace ckc {

std::unique_ptr<Trajectory> trajectory_from_table(const nb::dict& table, int size) {
  const auto kind = get<std::string>(table, "kind");
  if (kind == "harmonics") {
    const auto amplitude = get<Matrix>(table, "amplitude"), frequency = get<Matrix>(table, "frequency"),
               phase = get<Matrix>(table, "phase");
    const auto offset = get<Vector>(table, "offset");
    require(offset, size, "offset");
    for (const Matrix* m : {&amplitude, &frequency, &phase})
      require(m->rows() == size && m->cols() == amplitude.cols() && m->allFinite(),
              "harmonics: finite rows are needed");
    return std::make_unique<HarmonicTrajectory>(offset, amplitude, frequency, phase);
  }
  if (kind == "spline") {
    const auto breaks = get<Vector>(table, "breaks");
    const auto coefficients = get<std::vector<Matrix>>(table, "coefficients");
    require(breaks.size() > 1, "spline: at least two breaks are needed"), require(breaks, breaks.size(), "breaks");
    for (const Matrix& c : coefficients)
      require(c.rows() == breaks.size() - 1 && c.cols() == size && c.allFinite(),
              "spline: a finite row of coefficients for each piece is needed");
    return std::make_unique<SplineTrajectory>(breaks, coefficients);
  }
  if (kind == "sum") {
    std::vector<std::unique_ptr<Trajectory>> parts;
    for (const auto& part : get<std::vector<nb::dict>>(table, "parts"))
      parts.push_back(trajectory_from_table(part, size));
    return std::make_unique<SumTrajectory>(std::move(parts), size);
  }
  require(kind == "point", "desired: the kind must be harmonics, spline, sum or point");
  PointTrajectory::Task task{
      model_from_table(table),    get<Indices>(table, "q_index"), closure_from_table(get<nb::dict>(table, "closure")),
      get<Indices>(table, "psi"), get<Indices>(table, "axis"),    get<Vector>(table, "level")};
  const auto n = task.psi.size();
  require(task.axis.size() == n && task.level.size() == static_cast<Eigen::Index>(n),
          "point: psi, axis and level must have the same length");
  require_indices(task.psi, task.closure.rows, "psi");
  PointTrajectory::Knots knots{get<Vector>(table, "times"), get<Matrix>(table, "knots"), get<double>(table, "end"),
                               get<std::string>(table, "past_end")};
  require(
      knots.times.size() > 1 && knots.configurations.cols() == knots.times.size() && knots.configurations.allFinite(),
      "knots: a finite column per time is needed, and at least two");
  return std::make_unique<PointTrajectory>(std::move(task), trajectory_from_table(get<nb::dict>(table, "path"), 3),
                                           get<Indices>(table, "q"), std::move(knots), get<double>(table, "tolerance"));
}

namespace {

// A user's function, which returns an array, or a string that says why there is none.
class Callback {
 public:
  Callback(nb::object function, std::shared_ptr<View> view) : function_(std::move(function)), view_(std::move(view)) {}
  ~Callback() {
    nb::gil_scoped_acquire acquired;
    function_.reset();
  }

  bool operator()(const MeasuredState& at, Out values, ControlFailure& failure) const {
    nb::gil_scoped_acquire acquired;
    nb::object result;
    if (!view_->call(function_, at, failure, result)) return false;
    if (read(result, values)) return true;
    return failure.message = nb::cast<std::string>(result), false;
  }
  View& view() const { return *view_; }

 private:
  nb::object function_;
  std::shared_ptr<View> view_;
};

class CallbackWrench : public WrenchLaw {
 public:
  CallbackWrench(nb::object function, const std::shared_ptr<View>& view) : wrench_(std::move(function), view) {}
  bool evaluate(const MeasuredState& at, Out wrench, ControlFailure& failure) override {
    return wrench_(at, wrench, failure);
  }
  bool depends_on_state() const override { return true; }

 private:
  Callback wrench_;
};

// A user's controller, with u or torques.
class CallbackController : public Controller {
 public:
  CallbackController(const nb::dict& table, const std::shared_ptr<View>& view)
      : u_(nb::object(table["function"]), view),
        state_rate_(nb::object(table["state_rate"]), view),
        initial_state_(get<Vector>(table, "initial_state")),
        outputs_torques_(get<bool>(table, "outputs_torques")),
        differentiates_(get<bool>(table, "differentiates")) {}

  bool compute_u(const MeasuredState& at, Out u, ControlFailure& failure) override {
    t_ = at.t, v_ = at.v_tree, u_.view().law_state = state;
    return u_(at, u, failure);
  }
  Vector initial_state() const override { return initial_state_; }
  bool state_rate(const MeasuredState& at, Out rate, ControlFailure& failure) override {
    return state_rate_(at, rate, failure);
  }
  bool outputs_torques() const override { return outputs_torques_; }

  // With `differentiates`, central differences along each coordinate and rate of the tree, whether or not the loops allow them.
  bool derivatives(Core& core, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) override {
    if (!differentiates_) return false;
    const Vector q_tree = core.q_tree, v = v_;
    const auto d = static_cast<Eigen::Index>(fixed_q.size());
    Vector step = Vector::Zero(core.n), moved_q, moved_v, q(d), q_dot(d), moved_u(by_q.rows());
    ControlFailure failure;
    bool exists = true;
    const auto add = [&](int k, bool of_rate, double by, Matrix& derivative) {
      moved_q = q_tree, moved_v = v;
      step(k) = by;
      if (of_rate)
        moved_v += step;
      else
        core.tree.integrate(moved_q, step);
      step(k) = 0.0;
      core.set_configuration(moved_q);
      for (Eigen::Index i = 0; i < d; ++i)
        q(i) = moved_q(core.tree.q_index[fixed_q[i]]), q_dot(i) = moved_v(fixed_q[i]);
      exists = exists && compute_u({t_, core, q, q_dot, moved_v, q_dot}, moved_u, failure);
      derivative.col(k) += moved_u / (2.0 * by);
    };
    for (int k = 0; k < core.n; ++k)
      for (const double by : {difference, -difference}) add(k, false, by, by_q), add(k, true, by, by_v);
    if (failure.raised) u_.view().raised = nullptr;
    core.set_configuration(q_tree), core.set_velocity(v);
    v_ = v;
    return exists && by_q.allFinite() && by_v.allFinite();
  }

 private:
  static constexpr double difference = 6e-6;  // rad, m, rad/s, m/s: cube root of the machine epsilon
  Callback u_, state_rate_;
  const Vector initial_state_;
  const bool outputs_torques_, differentiates_;
  double t_ = 0.0;  // of the last u
  Vector v_;
};

void require_limits(const Vector& lower, const Vector& upper, Eigen::Index motors) {
  require(lower.size() == motors && upper.size() == motors && (lower.array() <= upper.array()).all(),
          "lower, upper: for each motor, a lower limit and one that is not smaller are needed");
}

Actuation actuation_from_table(const nb::dict& table, const Core& core) {
  const auto transmission = get<Matrix>(table, "transmission");
  const auto lower = get<Vector>(table, "lower"), upper = get<Vector>(table, "upper"), weights = get<Vector>(table, "weights"),
             preload = get<Vector>(table, "preload");
  const auto m = transmission.rows();
  require(transmission.cols() == core.n && transmission.allFinite(),
          "transmission: a finite column per coordinate is needed");
  require_limits(lower, upper, m);
  require(weights, m, "weights"), require(preload, m, "preload");
  require((weights.array() > 0).all(), "weights: positive numbers are needed");
  std::vector<std::vector<Actuation::Gear>> gears(m);
  for (Eigen::Index k = 0; k < m; ++k)
    for (int j = 0; j < core.n; ++j)
      if (transmission(k, j) != 0.0) gears[k].push_back({j, transmission(k, j)});
  return {core, std::move(gears), get<bool>(table, "direct"),
          Allocation(static_cast<int>(m), core.d, lower, upper, weights, preload)};
}

std::unique_ptr<Controller> joint_servo_from_table(const nb::dict& table, const Core& core, Eigen::Index motors) {
  std::vector<Servo> servos;
  for (const auto& servo : get<std::vector<nb::dict>>(table, "servos")) {
    servos.push_back({get<int>(servo, "motor"), get<int>(servo, "joint"), get<double>(servo, "gear"),
                      get<bool>(servo, "of_rate"), get<double>(servo, "K_P"), get<double>(servo, "K_I"),
                      get<double>(servo, "K_D"), get<double>(servo, "lower"), get<double>(servo, "upper"),
                      get<double>(servo, "unwinding")});
    require_indices({servos.back().motor}, static_cast<int>(motors), "motor of a servo");
    require_indices({servos.back().joint}, core.n, "joint of a servo");
    require(servos.back().gear != 0.0, "gear of a servo: a number other than zero is needed");
  }
  std::unique_ptr<Actuation> gravity;
  if (table.contains("gravity"))
    gravity = std::make_unique<Actuation>(actuation_from_table(get<nb::dict>(table, "gravity"), core));
  const auto size = static_cast<int>(servos.size());
  return std::make_unique<JointServo>(std::move(servos), trajectory_from_table(get<nb::dict>(table, "desired"), size),
                                      std::move(gravity));
}

}  // namespace

std::unique_ptr<Controller> controller_from_table(const nb::dict& table, const Core& core, Eigen::Index motors,
                                                  const std::shared_ptr<View>& view) {
  const auto kind = get<std::string>(table, "kind");
  if (kind == "call") return std::make_unique<CallbackController>(table, view);
  if (kind == "joint_servo") return joint_servo_from_table(table, core, motors);
  if (kind == "torques") {
    const auto times = get<Vector>(table, "times");
    const auto tau = get<Matrix>(table, "tau");
    require(times.size() > 0 && times.allFinite(), "torques: a time is needed");
    require(tau.cols() == times.size() && tau.rows() == motors && tau.allFinite(),
            "torques: a finite column for each time is needed");
    return std::make_unique<TorqueTable>(times, tau, get<bool>(table, "interpolates"));
  }
  const int d = core.d;
  if (kind == "set_point") {
    const auto K_P = get<Matrix>(table, "K_P"), K_V = get<Matrix>(table, "K_V");
    const auto q_d = get<Vector>(table, "q_d"), h_d = get<Vector>(table, "h_d");
    require_square(K_P, d, "K_P"), require_square(K_V, d, "K_V"), require(q_d, d, "q_d"), require(h_d, d, "h_d");
    return std::make_unique<SetPointController>(K_P, K_V, q_d, h_d, get<double>(table, "potential"));
  }
  require(kind == "tracking", "controller: the kind must be set_point, tracking, joint_servo, torques or call");
  const auto Lambda = get<Matrix>(table, "Lambda"), K_D = get<Matrix>(table, "K_D");
  require_square(Lambda, d, "Lambda"), require_square(K_D, d, "K_D");
  std::unique_ptr<Core> model;
  if (table.contains("model")) model = core_from_table(get<nb::dict>(table, "model"));
  require(!model || (model->n == core.n && model->q == core.q), "model: another partition than the plant's");
  return std::make_unique<TrackingController>(Lambda, K_D, trajectory_from_table(get<nb::dict>(table, "desired"), d),
                                              std::move(model), get<bool>(table, "actual"));
}

// The function's arguments are (view, stamp, t, numbers of `write_state`, q, z). The arrays are reused by all calls.
bool View::call(const nb::object& function, const MeasuredState& at, ControlFailure& failure, nb::object& result) {
  nb::gil_scoped_acquire acquired;
  ++calls;
  state_ = &at;
  ++stamp_;
  write_state(at);
  bool returned = true;
  try {
    result = function(nb::cast(shared_from_this()), stamp_, at.t, numbers_, partition_lists_.q, partition_lists_.z);
  } catch (...) {
    raised = std::current_exception();
    failure.raised = true;
    returned = false;
  }
  state_ = nullptr;
  return returned;
}

// q', v', q, q_dot, concatenated.
void View::write_state(const MeasuredState& at) {
  const Core& core = at.core;
  const size_t size = core.q_tree.size() + core.n + 2 * core.d;
  if (!data_) numbers_ = array(size, data_);
  partition_lists_.update(core);
  double* place = data_;
  for (const Vector* x : {&core.q_tree, &at.v_tree, &at.q, &at.q_dot})
    place = std::copy(x->data(), x->data() + x->size(), place);
}

nb::object View::term(long stamp, const std::string& name) {
  term_requested = true;
  if (!state_ || stamp != stamp_) return nb::none();
  state_->core.set_velocity(state_->v_tree);
  return term_by_name(state_->core, name);
}

std::unique_ptr<BodyForces> forces_from_tables(const std::vector<nb::dict>& tables, const Core& core,
                                               const std::shared_ptr<View>& view) {
  std::vector<BodyForce> forces;
  for (const nb::dict& table : tables) {
    std::unique_ptr<WrenchLaw> wrench;
    if (table.contains("function"))
      wrench = std::make_unique<CallbackWrench>(nb::object(table["function"]), view);
    else if (table.contains("constant")) {
      const auto constant = get<Vector>(table, "constant");
      require(constant, 6, "constant wrench");
      wrench = std::make_unique<ConstantWrench>(constant);
    } else
      wrench = std::make_unique<WrenchOverTime>(trajectory_from_table(get<nb::dict>(table, "values"), 6));
    const auto origin = get<Vector>(table, "origin");
    const auto axes = get<Matrix>(table, "axes");
    require(origin, 3, "origin of a force"), require_square(axes, 3, "axes of a force");
    forces.push_back({get<int>(table, "joint"), origin, axes, get<bool>(table, "in_world"), std::move(wrench)});
    require_indices({forces.back().joint}, core.tree.joints, "joint of a force");
  }
  return std::make_unique<BodyForces>(std::move(forces), core.n);
}

namespace {

// `transmission` (d, motors): u = transmission tau.
Vector allocate(MatrixArg transmission, VectorArg u, VectorArg lower, VectorArg upper, VectorArg weights,
                VectorArg preload) {
  const Eigen::Index d = transmission.rows(), m = transmission.cols();
  require(transmission.allFinite(), "transmission: finite numbers are needed");
  require(u, d, "u"), require(weights, m, "weights"), require(preload, m, "preload");
  require_limits(lower, upper, m);
  require((weights.array() > 0).all(), "weights: positive numbers are needed");
  Vector tau(m);
  Allocation(static_cast<int>(m), static_cast<int>(d), lower, upper, weights, preload)
      .allocate(transmission.transpose(), u, tau);
  return tau;
}

Sensor sensor_from_table(const nb::dict& table, const Core& core) {
  Sensor sensor;
  sensor.resolution = get<Vector>(table, "resolution");
  sensor.q_noise = get<Vector>(table, "q_noise"), sensor.q_dot_noise = get<Vector>(table, "q_dot_noise");
  require(sensor.resolution, core.d, "resolution");
  require(sensor.q_noise, core.d, "q_noise"), require(sensor.q_dot_noise, core.d, "q_dot_noise");
  sensor.differentiates = get<bool>(table, "differentiates"), sensor.smoothing = get<double>(table, "smoothing");
  sensor.seed = get<std::uint64_t>(table, "seed");
  if (table.contains("observer")) sensor.observer = core_from_table(get<nb::dict>(table, "observer"));
  return sensor;
}

}  // namespace

std::unique_ptr<Control> control_from_table(const nb::dict& table, const Core& core,
                                            const std::shared_ptr<View>& view) {
  auto control = std::make_unique<Control>(core, actuation_from_table(table, core));
  const auto motors = control->tau.size();
  if (table.contains("law")) control->law = controller_from_table(get<nb::dict>(table, "law"), core, motors, view);
  if (table.contains("clock")) {
    const auto clock = get<nb::dict>(table, "clock");
    Sampling& sampling = control->sampling.emplace();
    sampling.period = get<double>(clock, "period"), sampling.delay = get<double>(clock, "delay");
    sampling.times = get<Vector>(clock, "times");
  }
  if (table.contains("sensor")) control->sensor = sensor_from_table(get<nb::dict>(table, "sensor"), core);
  if (table.contains("drive")) {
    const auto drive = get<nb::dict>(table, "drive");
    control->drive = TorqueDrive{get<Vector>(drive, "resolution"), get<Vector>(drive, "rate"), Vector::Zero(motors)};
    require(control->drive->resolution, motors, "resolution");
    require(control->drive->rate.size() == motors, "rate: a number for each motor is needed");
  }
  require(control->sampling || !(control->sensor || control->drive), "sensor and drive: a clock is needed");
  return control;
}

void bind_allocation(nb::module_& m) {
  using namespace nb::literals;
  m.def("allocate", &allocate, "transmission"_a, "u"_a, "lower"_a, "upper"_a, "weights"_a, "preload"_a,
        "Return the motor torques with u = transmission tau that are nearest to a preload, within limits.");
}

}  // namespace ckc
