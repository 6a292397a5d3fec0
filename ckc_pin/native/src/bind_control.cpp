// What acts on a mechanism, from Python's tables; and a caller's own functions, which get the terms that the loop has.
#include <algorithm>
#include <limits>

#include <nanobind/stl/shared_ptr.h>

#include "bind_control.hpp"

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
  return std::make_unique<PointMotion>(get<std::string>(table, "model"), get<Indices>(table, "place"), std::move(task),
                                       motion_of(get<nb::dict>(table, "path"), 3), get<Indices>(table, "q"), times,
                                       knots, get<double>(table, "tolerance"), get<double>(table, "end"),
                                       get<std::string>(table, "past_end"));
}

// A caller's own, which gives u as an array of d doubles, or a string that says why there is none.
class Caller : public Controller {
 public:
  Caller(nb::object function, std::shared_ptr<View> view) : function_(std::move(function)), view_(std::move(view)) {}
  ~Caller() override {
    nb::gil_scoped_acquire acquired;
    function_.reset();
  }

  bool u(const Measured& at, Out u, Problem& problem) override {
    nb::gil_scoped_acquire acquired;
    nb::object answer;
    if (!view_->call(function_, at, problem, answer)) return false;
    if (read(answer, u.head(at.core.d))) return true;
    problem.says = nb::cast<std::string>(answer);
    return false;
  }

 private:
  nb::object function_;
  std::shared_ptr<View> view_;
};

std::unique_ptr<Controller> controller_of(const nb::dict& table, const Core& core, const std::shared_ptr<View>& view) {
  const auto kind = get<std::string>(table, "kind");
  if (kind == "call") return std::make_unique<Caller>(nb::object(table["function"]), view);
  const int d = core.d;
  if (kind == "set_point") {
    const auto K_P = get<Matrix>(table, "K_P"), K_V = get<Matrix>(table, "K_V");
    const auto q_d = get<Vector>(table, "q_d"), h_d = get<Vector>(table, "h_d");
    require_square(K_P, d, "K_P"), require_square(K_V, d, "K_V"), require(q_d, d, "q_d"), require(h_d, d, "h_d");
    return std::make_unique<SetPoint>(K_P, K_V, q_d, h_d, get<double>(table, "potential"));
  }
  require(kind == "tracking", "controller: set_point, tracking or call");
  const auto Lambda = get<Matrix>(table, "Lambda"), K_D = get<Matrix>(table, "K_D");
  require_square(Lambda, d, "Lambda"), require_square(K_D, d, "K_D");
  std::unique_ptr<Core> model;
  if (table.contains("model")) model = core_of(get<nb::dict>(table, "model"));
  require(!model || (model->n == core.n && model->q == core.q), "model: another partition than the plant's");
  return std::make_unique<Tracking>(Lambda, K_D, motion_of(get<nb::dict>(table, "desired"), d), std::move(model),
                                    get<bool>(table, "actual"));
}

}  // namespace

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
  if (!seen_ || stamp != stamp_) return nb::none();
  seen_->core.set_velocity(seen_->v_tree);
  return term_of(seen_->core, name);
}

std::unique_ptr<Control> control_of(const nb::dict& table, const Core& core, const std::shared_ptr<View>& view) {
  const auto at = get<Indices>(table, "actuated");
  const auto limit = get<Vector>(table, "limit");
  require_indices(at, core.n, "actuated");
  require(limit.size() == static_cast<Eigen::Index>(at.size()) && (limit.array() >= 0).all(),
          "limit: a positive number each");
  auto control = std::make_unique<Control>(core, at, get<bool>(table, "direct"), limit);
  if (table.contains("law")) control->law = controller_of(get<nb::dict>(table, "law"), core, view);
  if (table.contains("sample_time")) {
    Sampling& sampling = control->sampling.emplace();
    sampling.period = get<double>(table, "sample_time"), sampling.delay = get<double>(table, "delay");
  }
  return control;
}

}  // namespace ckc
