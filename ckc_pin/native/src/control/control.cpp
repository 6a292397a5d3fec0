#include "control/control.hpp"

#include <algorithm>

#include <Eigen/LU>

namespace ckc {

constexpr double max_relative_u_error = 1e-9;  // of the motors; a larger deviation from u means that limits act

SetPointController::SetPointController(Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential_d)
    : K_P_(std::move(K_P)),
      K_V_(std::move(K_V)),
      q_d_(std::move(q_d)),
      h_d_(std::move(h_d)),
      potential_d_(potential_d),
      e_(q_d_.size()),
      product_(q_d_.size()) {}

bool SetPointController::compute_u(const MeasuredState& at, Out u, ControlFailure&) {
  e_ = at.q - q_d_;
  u = h_d_;
  u.noalias() -= K_P_ * e_;
  u.noalias() -= K_V_ * at.q_dot;
  return true;
}

double SetPointController::lyapunov(const MeasuredState& at, double potential_energy, In) {
  at.core.compute_D();
  product_.noalias() = at.core.D * at.rate;  // independent of the coordinates of the motion
  const double kinetic = 0.5 * at.rate.dot(product_);
  e_ = at.q - q_d_;
  const double potential = potential_energy - potential_d_ - e_.dot(h_d_);
  product_.noalias() = K_P_ * e_;
  return kinetic + potential + 0.5 * e_.dot(product_);
}

TrackingController::TrackingController(Matrix Lambda, Matrix K_D, std::unique_ptr<Trajectory> desired,
                                       std::unique_ptr<Core> model, bool actual)
    : Lambda_(std::move(Lambda)),
      K_D_(std::move(K_D)),
      desired_(std::move(desired)),
      model_(std::move(model)),
      actual_(actual) {
  for (Vector* x : {&e_, &e_dot_, &v_, &a_, &r_, &product_, &Lambda_e_}) x->setZero(Lambda_.rows());
  if (model_) v_model_.setZero(model_->n);
}

bool TrackingController::move_desired(double begin, double end, In x) {
  Vector from(x.size()), rate(x.size()), acceleration(x.size());
  if (!desired()(begin, from, rate, acceleration)) return false;
  Matrix slopes = Matrix::Zero(2, x.size()), values(2, x.size());
  slopes.row(0) = (x - from).transpose() / (end - begin);
  values.row(0) = from.transpose(), values.row(1) = x.transpose();
  Vector breaks(3);
  breaks << begin, end, end + 1.0;
  commanded_ = std::make_unique<SplineTrajectory>(breaks, std::vector<Matrix>{slopes, values});
  commanded_->set_segment(begin, end, 0.0);
  return true;
}

// Evaluate e, e_dot, v, a and r at the measured state.
bool TrackingController::errors(const MeasuredState& at) {
  if (!desired()(at.t, e_, v_, a_)) return false;
  e_ = at.q - e_;
  e_dot_ = at.q_dot - v_;
  v_.noalias() -= Lambda_ * e_;
  a_.noalias() -= Lambda_ * e_dot_;
  r_ = at.q_dot - v_;
  return true;
}

bool TrackingController::compute_u(const MeasuredState& at, Out u, ControlFailure& failure) {
  if (!errors(at)) {
    failure.message = desired().failure;
    return false;
  }
  Core& core = model_ ? *model_ : at.core;
  if (model_) {
    core.set_configuration(at.core.q_tree, true);
    core.compute_rho();
    core.multiply_rho(at.q_dot, v_model_);
    if (actual_) v_model_ = at.v_tree;
    core.set_velocity(v_model_);
  }
  core.compute_D(), core.compute_coriolis();
  core.multiply_C(v_, product_);
  core.multiply_rho_transposed(core.h_tree, u);
  u += product_;
  u.noalias() += core.D * a_;
  u.noalias() -= K_D_ * r_;
  return true;
}

// With d1 = d2 = 1 and M = I.
double TrackingController::lyapunov(const MeasuredState& at, double, In w) {
  if (!errors(at)) return std::numeric_limits<double>::quiet_NaN();
  at.core.compute_D();
  product_.noalias() = at.core.D * r_;
  const double kinetic = 0.5 * r_.dot(product_);
  product_.noalias() = K_D_ * e_;
  Lambda_e_.noalias() = Lambda_ * e_;
  return kinetic + Lambda_e_.dot(product_) + 0.5 * w.squaredNorm();
}

bool TorqueTable::compute_u(const MeasuredState& at, Out tau, ControlFailure&) {
  const auto last = times_.size() - 1;
  const auto* after = std::upper_bound(times_.data(), times_.data() + times_.size(), at.t);
  auto k = std::max<Eigen::Index>(after - times_.data() - 1, 0);
  // The clock may be a rounding error before a tabulated time.
  if (!interpolates_ && k < last && times_(k + 1) - at.t < 1e-8 * (times_(k + 1) - times_(k))) ++k;
  tau = tau_.col(k);
  if (interpolates_ && k < last)
    tau += (at.t - times_(k)) / (times_(k + 1) - times_(k)) * (tau_.col(k + 1) - tau_.col(k));
  return true;
}

Actuation::Actuation(const Core& core, std::vector<std::vector<Gear>> gears_, bool is_direct_, Allocation allocation)
    : gears(std::move(gears_)), is_direct(is_direct_), allocation_(std::move(allocation)) {
  transmission_.setZero(static_cast<Eigen::Index>(gears.size()), core.d);  // u = transmission^T tau
}

void Actuation::motor_forces(In tau, Out u_tree) const {
  u_tree.setZero();
  for (size_t k = 0; k < gears.size(); ++k)
    for (const Gear& gear : gears[k]) u_tree(gear.joint) += gear.ratio * tau(static_cast<Eigen::Index>(k));
}

void Actuation::allocate(Core& core, Out u, Out tau, Out u_tree) {
  if (is_direct) {
    tau = u, clamp(tau);
  } else {
    core.compute_rho();
    transmission_.setZero();
    for (size_t k = 0; k < gears.size(); ++k)
      for (const Gear& gear : gears[k])
        transmission_.row(static_cast<Eigen::Index>(k)) += gear.ratio * core.rho.row(gear.joint);
    allocation_.allocate(transmission_, u, tau);
  }
  motor_forces(tau, u_tree);
  if (is_direct)
    u = tau;
  else
    u.noalias() = transmission_.transpose() * tau;
}

void Actuation::apply_torques(Out tau, Out u_tree) const {
  clamp(tau);
  motor_forces(tau, u_tree);
}

double Sampling::next_sample_time() const {
  if (times.size()) return next_sample < times.size() ? times(next_sample) : std::numeric_limits<double>::infinity();
  return static_cast<double>(next_sample) * period;
}

void Sampling::start(double t) {
  queue_size = 0;
  const double until = t + time_tolerance(t);
  if (times.size())
    next_sample = std::upper_bound(times.data(), times.data() + times.size(), until) - times.data() - 1;
  else
    next_sample = static_cast<long>(std::floor(until / period));
  next_sample = std::max(next_sample, 0L);
}

double Sampling::next_instant() const {
  const double sample = next_sample_time();
  return queue_size ? std::min(sample, queue[queue_begin].first) : sample;
}

void Sampling::queue_output(double t, In u) {
  if (queue_size == queue.size()) {
    std::rotate(queue.begin(), queue.begin() + static_cast<std::ptrdiff_t>(queue_begin), queue.end()), queue_begin = 0;
    queue.emplace_back();
  }
  auto& [when, value] = queue[(queue_begin + queue_size++) % queue.size()];
  when = t, value = u;
}

Control::Control(const Core& core, Actuation actuation) : actuation_(std::move(actuation)), fixed_q_(core.q) {
  for (Vector* x : {&constant, &u, &sample_, &requested_u_, &q_, &q_dot_}) x->setZero(core.d);
  tau.setZero(static_cast<Eigen::Index>(actuation_.gears.size()));
  u_tree.setZero(core.n), requested_force_.setZero(core.n);
  to_fixed_q_.setZero(core.d, core.d);
}

void Control::start(double t) {
  if (law) law->reset(), law->state = law->initial_state();
  if (!sampling) return;
  sampling->start(t);
  constant_is_torque = drive || (law && law->outputs_torques());
  constant.setZero(constant_is_torque ? tau.size() : u.size());
  sample_ = constant;
  if (sensor) sensor->reset();
  if (drive) drive->output.setZero(tau.size());
}

bool Control::set_constant(In value, bool outputs_torques) {
  if (outputs_torques == constant_is_torque && value.size() == constant.size() && value == constant) return false;
  constant = value, constant_is_torque = outputs_torques;
  return true;
}

bool Control::needs_fixed_partition() const {
  if (!is_active()) return false;
  if (!law) return !constant_is_torque;
  return law->needs_fixed_partition() || !(actuation_.is_direct || law->outputs_torques());
}

MeasuredState Control::in_fixed_partition(const MeasuredState& at) {
  if (at.core.q == fixed_q_) return at;
  for (size_t k = 0; k < fixed_q_.size(); ++k) {
    q_(k) = at.core.q_tree(at.core.tree.q_index[fixed_q_[k]]);
    q_dot_(k) = at.v_tree(fixed_q_[k]);
  }
  return {at.t, at.core, q_, q_dot_, at.v_tree, at.rate};
}

bool SetPointController::derivatives(Core&, const Indices& fixed_q, Matrix& by_q, Matrix& by_v) {
  for (size_t k = 0; k < fixed_q.size(); ++k) {
    const auto column = static_cast<Eigen::Index>(k);
    by_q.col(fixed_q[k]) = -K_P_.col(column), by_v.col(fixed_q[k]) = -K_V_.col(column);
  }
  return true;
}

void SetPointController::gain_derivative(const MeasuredState& at, const Matrix& K_P, const Matrix& K_V,
                                         Out derivative) {
  e_ = at.q - q_d_;
  derivative.noalias() = K_P * e_;
  derivative.noalias() += K_V * at.q_dot;
  derivative = -derivative;
}

// Motors at their limits do not respond to the state. As long as motors on other coordinates than q produce u, its
// derivatives do not depend on the allocation. Otherwise the motors within their limits respond as they would without
// limits.
bool Control::derivatives(Core& core, Matrix& by_q, Matrix& by_v, Vector& force) {
  const auto n = u_tree.size();
  by_q.setZero(n, n), by_v.setZero(n, n);
  force = u_tree;
  u_by_q_.setZero(u.size(), n), u_by_v_.setZero(u.size(), n);
  limited_motors.exist = false;
  if (!is_active() || outputs_torques()) return !is_feedback() || torque_derivatives(core, by_q, by_v);
  limited_motors.exist =
      !actuation_.is_direct && !((u - requested_).norm() <= max_relative_u_error * requested_.norm());
  if (limited_motors.exist && actuation_.is_redundant()) return false;
  if (is_feedback() && !law->derivatives(core, fixed_q_, u_by_q_, u_by_v_)) return false;
  if (limited_motors.exist) return limited_motor_derivatives(core, by_q, by_v);
  if (!actuation_.is_direct) {
    force.setZero();
    for (size_t i = 0; i < fixed_q_.size(); ++i) force(fixed_q_[i]) = u(static_cast<Eigen::Index>(i));
  }
  for (Eigen::Index i = 0; i < u.size(); ++i)
    if (responds(i)) by_q.row(fixed_q_[i]) = u_by_q_.row(i), by_v.row(fixed_q_[i]) = u_by_v_.row(i);
  return true;
}

bool Control::torque_derivatives(Core& core, Matrix& by_q, Matrix& by_v) {
  const auto n = u_tree.size();
  Matrix tau_by_q = Matrix::Zero(tau.size(), n), tau_by_v = tau_by_q;
  if (!law->derivatives(core, fixed_q_, tau_by_q, tau_by_v)) return false;
  for (size_t k = 0; k < actuation_.gears.size(); ++k) {
    const auto motor = static_cast<Eigen::Index>(k);
    if (is_at_limit(motor)) continue;
    for (const Actuation::Gear& gear : actuation_.gears[k]) {
      by_q.row(gear.joint) += gear.ratio * tau_by_q.row(motor);
      by_v.row(gear.joint) += gear.ratio * tau_by_v.row(motor);
    }
  }
  return true;
}

// Let f be the forces of the motors without limits, and f + J^T lambda = u on q. The derivative of tau follows from
// du = rho^T (df + d(J^T) lambda).
bool Control::limited_motor_derivatives(Core& core, Matrix& by_q, Matrix& by_v) {
  core.compute_rho();
  const auto n = u_tree.size();
  Matrix transmission_tree = Matrix::Zero(tau.size(), n);
  for (size_t k = 0; k < actuation_.gears.size(); ++k)
    for (const Actuation::Gear& gear : actuation_.gears[k])
      transmission_tree(static_cast<Eigen::Index>(k), gear.joint) += gear.ratio;
  const Eigen::PartialPivLU<Matrix> transmission(core.rho.transpose() * transmission_tree.transpose());
  limited_motors.tau = transmission.solve(requested_), limited_motors.response = transmission.inverse();
  for (Eigen::Index k = 0; k < tau.size(); ++k)
    if (is_at_limit(k)) limited_motors.response.row(k).setZero();
  Vector residual_force = -transmission_tree.transpose() * limited_motors.tau;
  for (size_t i = 0; i < fixed_q_.size(); ++i) residual_force(fixed_q_[i]) += requested_(static_cast<Eigen::Index>(i));
  limited_motors.lambda.setZero(core.constraints.closure.rows),
      core.minimum_norm_multipliers(residual_force, limited_motors.lambda);
  const Vector none = Vector::Zero(n), v = core.v_tree;
  core.derivatives.compute(core.q_tree, none, none, limited_motors.lambda, true);
  limited_motors.by_q = limited_motors.response * (u_by_q_ + core.rho.transpose() * core.derivatives.force_by_q);
  limited_motors.by_v = limited_motors.response * u_by_v_;
  by_q = transmission_tree.transpose() * limited_motors.by_q,
  by_v = transmission_tree.transpose() * limited_motors.by_v;
  core.set_velocity(v);
  return by_q.allFinite() && by_v.allFinite();
}

bool Control::evaluate_law(const MeasuredState& at, Out u) {
  return law->compute_u(in_fixed_partition(at), u, failure) && check_finite(u);
}

bool Control::check_finite(In u) {
  if (u.allFinite()) return true;
  failure.u = u;
  return false;
}

bool Control::compute(const MeasuredState& at) {
  const bool torques = outputs_torques();
  if (is_feedback()) {
    if (!evaluate_law(at, torques ? Out(tau) : Out(u))) return false;
  } else if (torques) {
    tau = constant;
  } else {
    u = constant;
  }
  if (!is_active())
    tau.setZero(), u_tree.setZero();
  else if (torques)
    actuation_.apply_torques(tau, u_tree);
  else
    requested_ = u, actuation_.allocate(at.core, u, tau, u_tree);
  return true;
}

void Control::recover_u(Core& core) {
  if (!outputs_torques()) return;
  if (actuation_.is_direct) {
    u = tau;
    return;
  }
  core.compute_rho();
  core.multiply_rho_transposed(u_tree, u);
  if (core.q == fixed_q_) return;
  for (size_t k = 0; k < fixed_q_.size(); ++k)
    to_fixed_q_.row(static_cast<Eigen::Index>(k)) = core.rho.row(fixed_q_[k]);
  u = to_fixed_q_.transpose().partialPivLu().solve(Vector(u));
}

bool Control::evaluate_sample(const MeasuredState& at) {
  const MeasuredState fixed = in_fixed_partition(at);
  if (sensor) sensor->measure(fixed.q, fixed.q_dot, sampling->period);
  if (sensor && sensor->observer && !sensor->project_observer(at.core.q_tree)) {
    failure.message = "the loops cannot be closed at the measured q";
    return false;
  }
  const MeasuredState state =
      !sensor ? fixed
      : sensor->observer
          ? MeasuredState{at.t, *sensor->observer, sensor->q, sensor->q_dot, sensor->v_tree, sensor->q_dot}
          : MeasuredState{at.t, at.core, sensor->q, sensor->q_dot, at.v_tree, at.rate};
  const bool torques = law->outputs_torques();
  Vector& output = drive && !torques ? requested_u_ : sample_;
  if (!law->compute_u(state, output, failure) || !check_finite(output)) return false;
  if (law->state.size()) {  // the state is held with the output
    law_rate_.resize(law->state.size());
    if (!law->state_rate(state, law_rate_, failure)) return false;
    law->state += sampling->period * law_rate_;
  }
  if (!drive) return true;
  if (torques)
    actuation_.clamp(sample_);
  else
    actuation_.allocate(state.core, requested_u_, sample_, requested_force_);
  drive->limit_and_quantize(sample_, sampling->period);
  return true;
}

bool Control::sample(const MeasuredState& at, bool& changed) {
  changed = false;
  sampling->samples_taken = sampling->outputs_applied = 0;
  const double now = at.t + sampling->time_tolerance(at.t);
  const double sample = sampling->next_sample_time();
  if (sample <= now) {
    if (!evaluate_sample(at)) return false;
    ++sampling->samples_taken;
    sampling->queue_output(sample + sampling->delay, sample_);
    ++sampling->next_sample;
  }
  for (; sampling->queue_size && sampling->queue[sampling->queue_begin].first <= now; --sampling->queue_size) {
    const Vector& value = sampling->queue[sampling->queue_begin].second;
    changed |= set_constant(value, constant_is_torque);
    ++sampling->outputs_applied;
    sampling->queue_begin = (sampling->queue_begin + 1) % sampling->queue.size();
  }
  return true;
}

double Control::lyapunov(const MeasuredState& at, double potential_energy, In w) {
  return law ? law->lyapunov(in_fixed_partition(at), potential_energy, w) : 0.0;
}

}  // namespace ckc
