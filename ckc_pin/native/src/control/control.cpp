#include "control/control.hpp"

#include <algorithm>

#include <Eigen/LU>

namespace ckc {

constexpr double realised = 1e-9;  // of u: what motors make of it is it

SetPoint::SetPoint(Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential_d)
    : K_P_(std::move(K_P)),
      K_V_(std::move(K_V)),
      q_d_(std::move(q_d)),
      h_d_(std::move(h_d)),
      potential_d_(potential_d),
      e_(q_d_.size()),
      product_(q_d_.size()) {}

bool SetPoint::u(const Measured& at, Out u, Problem&) {
  e_ = at.q - q_d_;
  u = h_d_;
  u.noalias() -= K_P_ * e_;
  u.noalias() -= K_V_ * at.q_dot;
  return true;
}

double SetPoint::lyapunov(const Measured& at, double potential_energy, In) {
  at.core.inertia();
  product_.noalias() = at.core.D * at.rate;  // in whichever coordinates the motion is
  const double kinetic = 0.5 * at.rate.dot(product_);
  e_ = at.q - q_d_;
  const double fallen = potential_energy - potential_d_ - e_.dot(h_d_);
  product_.noalias() = K_P_ * e_;
  return kinetic + fallen + 0.5 * e_.dot(product_);
}

Tracking::Tracking(Matrix Lambda, Matrix K_D, std::unique_ptr<Motion> desired, std::unique_ptr<Core> model, bool actual)
    : Lambda_(std::move(Lambda)),
      K_D_(std::move(K_D)),
      desired_(std::move(desired)),
      model_(std::move(model)),
      actual_(actual) {
  for (Vector* x : {&e_, &e_dot_, &v_, &a_, &r_, &product_, &turned_}) x->setZero(Lambda_.rows());
  if (model_) v_model_.setZero(model_->n);
}

// e, its rate, v, a and r there.
bool Tracking::errors(const Measured& at) {
  if (!(*desired_)(at.t, e_, v_, a_)) return false;
  e_ = at.q - e_;
  e_dot_ = at.q_dot - v_;
  v_.noalias() -= Lambda_ * e_;
  a_.noalias() -= Lambda_ * e_dot_;
  r_ = at.q_dot - v_;
  return true;
}

bool Tracking::u(const Measured& at, Out u, Problem& problem) {
  if (!errors(at)) {
    problem.says = desired_->problem;
    return false;
  }
  Core& core = model_ ? *model_ : at.core;
  if (model_) {
    core.set(at.core.q_tree, true);
    core.reduce();
    core.velocity(at.q_dot, v_model_);
    if (actual_) v_model_ = at.v_tree;
    core.set_velocity(v_model_);
  }
  core.inertia(), core.coriolis();
  core.C_times(v_, product_);
  core.reduced(core.h_tree, u);
  u += product_;
  u.noalias() += core.D * a_;
  u.noalias() -= K_D_ * r_;
  return true;
}

// With d1 = d2 = 1 and M = I.
double Tracking::lyapunov(const Measured& at, double, In w) {
  if (!errors(at)) return std::numeric_limits<double>::quiet_NaN();
  at.core.inertia();
  product_.noalias() = at.core.D * r_;
  const double kinetic = 0.5 * r_.dot(product_);
  product_.noalias() = K_D_ * e_;
  turned_.noalias() = Lambda_ * e_;
  return kinetic + turned_.dot(product_) + 0.5 * w.squaredNorm();
}

bool Torques::u(const Measured& at, Out tau, Problem&) {
  const auto last = times_.size() - 1;
  const auto* after = std::upper_bound(times_.data(), times_.data() + times_.size(), at.t);
  auto k = std::max<Eigen::Index>(after - times_.data() - 1, 0);
  // the clock may come to an instant from below
  if (!lines_ && k < last && times_(k + 1) - at.t < 1e-8 * (times_(k + 1) - times_(k))) ++k;
  tau = tau_.col(k);
  if (lines_ && k < last) tau += (at.t - times_(k)) / (times_(k + 1) - times_(k)) * (tau_.col(k + 1) - tau_.col(k));
  return true;
}

Actuation::Actuation(const Core& core, std::vector<std::vector<Gear>> gears_, bool direct_, Allocation allocation)
    : gears(std::move(gears_)), direct(direct_), allocation_(std::move(allocation)) {
  transmission_.setZero(static_cast<Eigen::Index>(gears.size()), core.d);  // u = transmission^T tau
}

void Actuation::push(In tau, Out u_tree) const {
  u_tree.setZero();
  for (size_t k = 0; k < gears.size(); ++k)
    for (const Gear& gear : gears[k]) u_tree(gear.joint) += gear.turns * tau(static_cast<Eigen::Index>(k));
}

void Actuation::apply(Core& core, Out u, Out tau, Out u_tree) {
  if (direct) {
    tau = u, clip(tau);
  } else {
    core.reduce();
    transmission_.setZero();
    for (size_t k = 0; k < gears.size(); ++k)
      for (const Gear& gear : gears[k])
        transmission_.row(static_cast<Eigen::Index>(k)) += gear.turns * core.rho.row(gear.joint);
    allocation_.share(transmission_, u, tau);
  }
  push(tau, u_tree);
  if (direct)
    u = tau;
  else
    u.noalias() = transmission_.transpose() * tau;
}

void Actuation::drive(Out tau, Out u_tree) const {
  clip(tau);
  push(tau, u_tree);
}

double Sampling::due() const {
  if (times.size()) return next < times.size() ? times(next) : std::numeric_limits<double>::infinity();
  return static_cast<double>(next) * period;
}

double Sampling::instant() const {
  const double sample = due();
  return count ? std::min(sample, ring[first].first) : sample;
}

void Sampling::put(double t, In u) {
  if (count == ring.size()) {
    std::rotate(ring.begin(), ring.begin() + static_cast<std::ptrdiff_t>(first), ring.end()), first = 0;
    ring.emplace_back();
  }
  auto& [when, value] = ring[(first + count++) % ring.size()];
  when = t, value = u;
}

Control::Control(const Core& core, Actuation actuation) : actuation_(std::move(actuation)), own_(core.q) {
  for (Vector* x : {&constant, &u, &sampled_, &asked_, &q_, &q_dot_}) x->setZero(core.d);
  tau.setZero(static_cast<Eigen::Index>(actuation_.gears.size()));
  u_tree.setZero(core.n), pushed_.setZero(core.n);
  to_own_.setZero(core.d, core.d);
}

void Control::begin() {
  if (!sampling) return;
  sampling->next = 0, sampling->count = 0;
  constant_of_motors = drive || (law && law->of_motors());
  constant.setZero(constant_of_motors ? tau.size() : u.size());
  sampled_ = constant;
  if (sensor) sensor->begin();
  if (drive) drive->sent.setZero(tau.size());
}

bool Control::hold(In value, bool of_motors) {
  if (of_motors == constant_of_motors && value.size() == constant.size() && value == constant) return false;
  constant = value, constant_of_motors = of_motors;
  return true;
}

bool Control::needs_own_partition() const {
  if (!acts()) return false;
  if (!law) return !constant_of_motors;
  return law->needs_terms() || !(actuation_.direct || law->of_motors());
}

Measured Control::in_own_q(const Measured& at) {
  if (at.core.q == own_) return at;
  for (size_t k = 0; k < own_.size(); ++k) {
    q_(k) = at.core.q_tree(at.core.tree.place[own_[k]]);
    q_dot_(k) = at.v_tree(own_[k]);
  }
  return {at.t, at.core, q_, q_dot_, at.v_tree, at.rate};
}

bool SetPoint::slopes(Core&, const Indices& own, Matrix& by_q, Matrix& by_v) {
  for (size_t k = 0; k < own.size(); ++k) {
    const auto column = static_cast<Eigen::Index>(k);
    by_q.col(own[k]) = -K_P_.col(column), by_v.col(own[k]) = -K_V_.col(column);
  }
  return true;
}

void SetPoint::by_gains(const Measured& at, const Matrix& K_P, const Matrix& K_V, Out more) {
  e_ = at.q - q_d_;
  more.noalias() = K_P * e_;
  more.noalias() += K_V * at.q_dot;
  more = -more;
}

// Where an actuator is at its limit, it does not answer. Motors that are not q's own share u: as long as they amount to
// it, it does not matter which; where they do not, those within their limits do as they would without any.
bool Control::slopes(Core& core, Matrix& by_q, Matrix& by_v, Vector& force) {
  const auto n = u_tree.size();
  by_q.setZero(n, n), by_v.setZero(n, n);
  force = u_tree;
  slope_.setZero(u.size(), n), slope_dot_.setZero(u.size(), n);
  clipped.any = false;
  if (!acts() || of_motors()) return !feedback() || law->slopes(core, own_, slope_, slope_dot_);
  clipped.any = !actuation_.direct && !((u - wanted_).norm() <= realised * wanted_.norm());
  if (clipped.any && actuation_.redundant()) return false;
  if (feedback() && !law->slopes(core, own_, slope_, slope_dot_)) return false;
  if (clipped.any) return clip(core, by_q, by_v);
  if (!actuation_.direct) {
    force.setZero();
    for (size_t i = 0; i < own_.size(); ++i) force(own_[i]) = u(static_cast<Eigen::Index>(i));
  }
  for (Eigen::Index i = 0; i < u.size(); ++i)
    if (answers(i)) by_q.row(own_[i]) = slope_.row(i), by_v.row(own_[i]) = slope_dot_.row(i);
  return true;
}

// With f what the motors would do without limits, f + J^T lambda = u on q: dtau follows from du = rho^T (df + d(J^T) lambda).
bool Control::clip(Core& core, Matrix& by_q, Matrix& by_v) {
  core.reduce();
  const auto n = u_tree.size();
  Matrix turns = Matrix::Zero(tau.size(), n);
  for (size_t k = 0; k < actuation_.gears.size(); ++k)
    for (const Actuation::Gear& gear : actuation_.gears[k]) turns(static_cast<Eigen::Index>(k), gear.joint) += gear.turns;
  const Eigen::PartialPivLU<Matrix> transmission(core.rho.transpose() * turns.transpose());
  clipped.tau = transmission.solve(wanted_), clipped.answer = transmission.inverse();
  for (Eigen::Index k = 0; k < tau.size(); ++k)
    if (limited(k)) clipped.answer.row(k).setZero();
  Vector lacking = -turns.transpose() * clipped.tau;
  for (size_t i = 0; i < own_.size(); ++i) lacking(own_[i]) += wanted_(static_cast<Eigen::Index>(i));
  clipped.lambda.setZero(core.rows.closure.rows), core.multipliers(lacking, clipped.lambda);
  const Vector none = Vector::Zero(n), v = core.v_tree;
  core.derivatives.compute(core.q_tree, none, none, clipped.lambda, true);
  clipped.by_q = clipped.answer * (slope_ + core.rho.transpose() * core.derivatives.force_by_q);
  clipped.by_v = clipped.answer * slope_dot_;
  by_q = turns.transpose() * clipped.by_q, by_v = turns.transpose() * clipped.by_v;
  core.set_velocity(v);
  return by_q.allFinite() && by_v.allFinite();
}

bool Control::ask(const Measured& at, Out u) { return law->u(in_own_q(at), u, problem) && known(u); }

bool Control::known(In u) {
  if (u.allFinite()) return true;
  problem.u = u;
  return false;
}

bool Control::act(const Measured& at) {
  const bool torques = of_motors();
  if (feedback()) {
    if (!ask(at, torques ? Out(tau) : Out(u))) return false;
  } else if (torques) {
    tau = constant;
  } else {
    u = constant;
  }
  if (!acts())
    tau.setZero(), u_tree.setZero();
  else if (torques)
    actuation_.drive(tau, u_tree);
  else
    wanted_ = u, actuation_.apply(at.core, u, tau, u_tree);
  return true;
}

void Control::settle_u(Core& core) {
  if (!of_motors()) return;
  if (actuation_.direct) {
    u = tau;
    return;
  }
  core.reduce();
  core.reduced(u_tree, u);
  if (core.q == own_) return;
  for (size_t k = 0; k < own_.size(); ++k) to_own_.row(static_cast<Eigen::Index>(k)) = core.rho.row(own_[k]);
  u = to_own_.transpose().partialPivLu().solve(Vector(u));
}


bool Control::answer(const Measured& at) {
  const Measured here = in_own_q(at);
  if (sensor) sensor->look(here.q, here.q_dot, sampling->period);
  if (sensor && sensor->observer && !sensor->close(at.core.q_tree)) {
    problem.says = "the loops do not close at what the sensors say of q";
    return false;
  }
  const Measured seen = !sensor ? here
                        : sensor->observer
                            ? Measured{at.t, *sensor->observer, sensor->q, sensor->q_dot, sensor->v_tree, sensor->q_dot}
                            : Measured{at.t, at.core, sensor->q, sensor->q_dot, at.v_tree, at.rate};
  const bool torques = law->of_motors();
  Vector& asked = drive && !torques ? asked_ : sampled_;
  if (!law->u(seen, asked, problem) || !known(asked)) return false;
  if (!drive) return true;
  if (torques)
    actuation_.clip(sampled_);
  else
    actuation_.apply(seen.core, asked_, sampled_, pushed_);
  drive->limit(sampled_, sampling->period);
  return true;
}

bool Control::sample(const Measured& at, bool& changed) {
  changed = false;
  sampling->taken = sampling->acted = 0;
  const double now = at.t + sampling->near(at.t);
  const double sample = sampling->due();
  if (sample <= now) {
    if (sampling->holds) {
      if (!answer(at)) return false;
      ++sampling->taken;
      sampling->put(sample + sampling->delay, sampled_);
    } else {
      changed = true;
    }
    ++sampling->next;
  }
  for (; sampling->count && sampling->ring[sampling->first].first <= now; --sampling->count) {
    const Vector& value = sampling->ring[sampling->first].second;
    changed |= hold(value, constant_of_motors);
    ++sampling->acted;
    sampling->first = (sampling->first + 1) % sampling->ring.size();
  }
  return true;
}

double Control::lyapunov(const Measured& at, double potential_energy, In w) {
  return law ? law->lyapunov(in_own_q(at), potential_energy, w) : 0.0;
}

}  // namespace ckc
