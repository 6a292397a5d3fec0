#include "drive.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ckc {

void Desired::operator()(double t, Out q, Out q_dot, Out q_ddot) const {
  if (breaks.size() == 0) {
    q = offset, q_dot.setZero(), q_ddot.setZero();
    for (Eigen::Index k = 0; k < amplitude.rows(); ++k)
      for (Eigen::Index i = 0; i < amplitude.cols(); ++i) {
        const double rate = frequency(k, i), angle = rate * t + phase(k, i);
        const double sine = amplitude(k, i) * std::sin(angle), cosine = amplitude(k, i) * std::cos(angle);
        q(k) += sine, q_dot(k) += rate * cosine, q_ddot(k) -= rate * rate * sine;
      }
    return;
  }
  const double* begin = breaks.data();
  const auto pieces = breaks.size() - 1;
  const auto piece = std::clamp<Eigen::Index>(std::upper_bound(begin, begin + pieces, t) - begin - 1, 0, pieces - 1);
  const double x = t - breaks(piece);
  q.setZero(), q_dot.setZero(), q_ddot.setZero();
  for (const Matrix& c : coefficients) {  // Horner, with both derivatives
    q_ddot = q_ddot * x + 2 * q_dot;
    q_dot = q_dot * x + q;
    q = q * x + c.row(piece).transpose();
  }
}

Drive::Drive(int d, int n) {
  held.setZero(d), limit.setConstant(d, std::numeric_limits<double>::infinity());
  for (Vector* x : {&tau, &q_d_, &q_d_dot_, &q_d_ddot_, &v_, &a_, &r_, &C_v_}) x->setZero(d);
  u_tree.setZero(n), tree_.setZero(n);
}

void Drive::act(double t, Core& core, In q, In q_dot) {
  tau = held;
  if (set_point) {
    v_ = q - set_point->q_d;
    tau = set_point->h_d;
    tau.noalias() -= set_point->K_P * v_;
    tau.noalias() -= set_point->K_V * q_dot;
  } else if (tracking) {
    track(t, core, q, q_dot);
  }
  u_tree.setZero();
  for (int k = 0; k < core.d; ++k) {
    tau(k) = std::min(std::max(tau(k), -limit(k)), limit(k));
    u_tree(core.q[k]) = tau(k);
  }
}

void Drive::track(double t, Core& core, In q, In q_dot) {
  tracking->desired(t, q_d_, q_d_dot_, q_d_ddot_);
  q_d_ = q - q_d_;  // e
  v_ = q_d_dot_;
  v_.noalias() -= tracking->Lambda * q_d_;
  q_d_dot_ = q_dot - q_d_dot_;  // its rate
  a_ = q_d_ddot_;
  a_.noalias() -= tracking->Lambda * q_d_dot_;
  r_ = q_dot - v_;
  core.coriolis();
  core.C_times(v_, C_v_);
  core.reduced(core.h_tree, tau);
  tau += C_v_;
  tau.noalias() += core.D * a_;
  tau.noalias() -= tracking->K_D * r_;
}

double Drive::lyapunov(const Core& core, double potential_energy, In q, In q_dot, In w) {
  if (set_point) {
    v_ = q - set_point->q_d;
    const double fallen = potential_energy - set_point->potential - v_.dot(set_point->h_d);
    r_.noalias() = core.D * q_dot;
    a_.noalias() = set_point->K_P * v_;
    return 0.5 * q_dot.dot(r_) + fallen + 0.5 * v_.dot(a_);
  }
  // q_d_ is e since `track`, and r_ is r
  C_v_.noalias() = core.D * r_;
  v_.noalias() = tracking->K_D * q_d_;
  a_.noalias() = tracking->Lambda * q_d_;
  return 0.5 * r_.dot(C_v_) + a_.dot(v_) + 0.5 * w.squaredNorm();
}

void Drive::rate_gradient(double t, Core& core, In q, In q_dot, Matrix& gradient) {
  act(t, core, q, q_dot);
  gradient.setZero();
  if (set_point) {
    gradient = -set_point->K_V;
  } else if (tracking) {
    // C is linear in its velocity and C(x) y = C(y) x
    core.velocity(v_, tree_);
    core.bias(tree_);
    core.coriolis();
    for (int k = 0; k < core.d; ++k) {
      r_.setZero();
      r_(k) = 1.0;
      core.C_times(r_, C_v_);
      gradient.col(k) = C_v_ - tracking->K_D.col(k);
    }
    gradient.noalias() -= core.D * tracking->Lambda;
  }
  for (int k = 0; k < core.d; ++k)
    if (!(std::abs(tau(k)) < limit(k))) gradient.row(k).setZero();
}

}  // namespace ckc
