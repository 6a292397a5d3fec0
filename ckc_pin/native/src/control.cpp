#include "control.hpp"

#include <algorithm>

namespace ckc {

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
  for (Vector* x : {&e_, &e_dot_, &v_, &a_, &r_, &product_}) x->setZero(Lambda_.rows());
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
  v_.noalias() = K_D_ * e_;
  a_.noalias() = Lambda_ * e_;
  return 0.5 * r_.dot(product_) + a_.dot(v_) + 0.5 * w.squaredNorm();
}

Actuation::Actuation(const Core& core, Indices at_, bool direct_, Vector limit)
    : at(std::move(at_)), direct(direct_), limit_(std::move(limit)) {
  if (direct) return;
  const int m = static_cast<int>(at.size());
  transmission_.setZero(m, core.d);  // u = transmission^T tau
  if (m == core.d)
    factor_.shape(m, m, full_pattern(m));
  else
    factor_.shape(m, core.d, std::vector<Indices>(m));
}

void Actuation::apply(Core& core, Out u, Out tau, Out u_tree) {
  const auto m = static_cast<Eigen::Index>(at.size());
  if (direct) {
    tau = u;
  } else {
    core.reduce();
    for (Eigen::Index k = 0; k < m; ++k) transmission_.row(k) = core.rho.row(at[k]);
    if (m == core.d) {
      transmission_.transposeInPlace();
      factor_.compute(transmission_), factor_.solve(u, tau);
      transmission_.transposeInPlace();
    } else {
      factor_.compute(transmission_), factor_.solve_transposed(u, tau);
    }
  }
  tau = tau.cwiseMin(limit_).cwiseMax(-limit_);
  u_tree.setZero();
  for (Eigen::Index k = 0; k < m; ++k) u_tree(at[k]) = tau(k);
  if (direct)
    u = tau;
  else
    u.noalias() = transmission_.transpose() * tau;
}

double Sampling::instant() const {
  const double sample = static_cast<double>(next) * period;
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

Control::Control(const Core& core, Indices actuated, bool direct, Vector limit)
    : actuation_(core, std::move(actuated), direct, std::move(limit)), own_(core.q) {
  for (Vector* x : {&constant, &u, &sampled_, &q_, &q_dot_}) x->setZero(core.d);
  tau.setZero(actuation_.at.size()), u_tree.setZero(core.n);
}

void Control::begin() {
  if (!sampling) return;
  sampling->next = 0, sampling->count = 0;
  constant.setZero();
}

Measured Control::in_own_q(const Measured& at) {
  if (at.core.q == own_) return at;
  for (size_t k = 0; k < own_.size(); ++k) {
    q_(k) = at.core.q_tree(at.core.tree.place[own_[k]]);
    q_dot_(k) = at.v_tree(own_[k]);
  }
  return {at.t, at.core, q_, q_dot_, at.v_tree, at.rate};
}

bool SetPoint::slopes(Matrix& by_q, Matrix& by_q_dot) const { return by_q = -K_P_, by_q_dot = -K_V_, true; }

// Where an actuator is at its limit, it does not answer.
bool Control::slopes(Matrix& by_q, Matrix& by_v) {
  const auto n = static_cast<int>(u_tree.size());
  by_q.setZero(n, n), by_v.setZero(n, n);
  if (!feedback()) return true;
  if (!actuation_.direct || !law->slopes(slope_, slope_dot_)) return false;
  for (size_t i = 0; i < own_.size(); ++i) {
    if (actuation_.limited(tau, static_cast<Eigen::Index>(i))) continue;
    for (size_t k = 0; k < own_.size(); ++k)
      by_q(actuation_.at[i], own_[k]) = slope_(i, k), by_v(actuation_.at[i], own_[k]) = slope_dot_(i, k);
  }
  return true;
}

bool Control::ask(const Measured& at, Out u) {
  if (!law->u(in_own_q(at), u, problem)) return false;
  if (u.allFinite()) return true;
  problem.u = u;
  return false;
}

bool Control::act(const Measured& at) {
  if (feedback()) {
    if (!ask(at, u)) return false;
  } else {
    u = constant;
  }
  if (acts())
    actuation_.apply(at.core, u, tau, u_tree);
  else
    tau.setZero(), u_tree.setZero();
  return true;
}

bool Control::sample(const Measured& at) {
  const double now = at.t + sampling->near(at.t);
  const double sample = static_cast<double>(sampling->next) * sampling->period;
  if (sample <= now) {
    if (!ask(at, sampled_)) return false;
    sampling->put(sample + sampling->delay, sampled_);
    ++sampling->next;
  }
  for (; sampling->count && sampling->ring[sampling->first].first <= now; --sampling->count) {
    constant = sampling->ring[sampling->first].second;
    sampling->first = (sampling->first + 1) % sampling->ring.size();
  }
  return true;
}

double Control::lyapunov(const Measured& at, double potential_energy, In w) {
  return law ? law->lyapunov(in_own_q(at), potential_energy, w) : 0.0;
}

}  // namespace ckc
