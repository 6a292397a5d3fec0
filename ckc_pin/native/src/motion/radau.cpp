#include "motion/radau.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

#include "motion/legendre.hpp"

namespace ckc {

constexpr double min_factor = 0.2, max_factor = 8.0, safety = 0.9;
// Largest ratio of the second Newton correction to the first. It may exceed 1, because z follows the corrections that
// stiff control causes in q one iteration later.
constexpr double max_second_correction = 2.0;
constexpr double jacobian_time = 0.8;         // fraction of the step at which the Jacobian is evaluated
constexpr double refresh_contraction = 0.02;  // Newton contraction above which the Jacobian is evaluated again
// A change of the step size within this range does not justify a new factorization.
constexpr double min_factor_kept = 0.9, max_factor_kept = 1.2;
constexpr double error_pessimism = 3.0;  // ratio of the error estimate to the error, with five or more stages
// Largest disagreement of z with its integrated rates, relative to the tolerance. It is larger than 1 because the rates
// are those before the last correction.
constexpr double max_disagreement = 10.0;
// Steps whose growth is limited after a failure of Newton's method, and that limit.
constexpr int cautious_steps = 3;
constexpr double cautious_growth = 1.5;
constexpr double slow_contraction = 0.3;  // Newton contraction above which the step does not grow

// A smaller tolerance allows more iterations; each gains about one digit.
static int max_iterations_for(int stages, double newton_tolerance) {
  return (stages == 7 ? 8 : 6) + std::max(0, int(-std::log10(newton_tolerance)));
}

static int stages_for(double rtol) { return rtol >= 1e-3 ? 3 : rtol > 1e-8 ? 5 : 7; }

Radau::Radau(System& system, Step& step, Work& work, const Tolerance& tolerance)
    : Method(system, step, work, tolerance),
      stages_(stages_for(tolerance.rtol)),
      max_iterations_(max_iterations_for(stages_, tolerance.newton)) {
  const int n = system.size, s = stages_;
  tabulate();
  Z_dot_.setZero(n, s), Z_.setZero(n, s), F_.setZero(n, s), dZ_.setZero(n, s);
  for (Vector* x : {&scale_, &error_, &y_stage_, &f_stage_, &real_rhs_, &real_correction_}) x->setZero(n);
  complex_rhs_.setZero(n), complex_correction_.setZero(n);
  complex_factors_.resize(s / 2);
  for (Polynomial* p : {&last_polynomial_, &step_polynomial_}) p->series.setZero(n, s), p->y.setZero(n);
}

// The nodes are the zeros of P_s - P_(s - 1), which include the right end. The other coefficients follow from them.
void Radau::tabulate() {
  const int s = stages_;
  const Vector nodes = radau_nodes(s);
  c_ = (1.0 + nodes.array()) / 2;
  legendre_integrals_.setZero(s);
  Matrix integral(s, s);
  for (int i = 0; i < s; ++i) evaluate_legendre_integrals(c_(i)), integral.row(i) = legendre_integrals_.transpose();
  A_inverse_ = legendre_values(nodes, s).transpose() * integral.inverse();
  b_ = legendre_values(nodes, s).partialPivLu().solve(integral.row(s - 1).transpose());
  to_series_ = integral.inverse().transpose();  // multiplies from the right
  // f(t, y) + sum of e_i z_i / h vanishes for polynomials up to degree s
  e_ = integral.transpose().partialPivLu().solve(-legendre_values(Vector::Constant(1, -1.0), s).col(0));
  const Eigen::EigenSolver<Matrix> eigen(A_inverse_);
  const Eigen::MatrixXcd inverse = eigen.eigenvectors().inverse();
  lambda_.resize(s / 2 + 1), V_.resize(s, s / 2 + 1), V_inverse_.resize(s / 2 + 1, s);
  int pair = 0;
  for (int k = 0; k < s; ++k) {
    const double imaginary = eigen.eigenvalues()(k).imag();
    if (imaginary < 0) continue;
    const int at = imaginary == 0 ? 0 : ++pair;  // the real eigenvalue first
    lambda_(at) = eigen.eigenvalues()(k), V_.col(at) = eigen.eigenvectors().col(k), V_inverse_.row(at) = inverse.row(k);
  }
}

// Integrals of the Legendre polynomials from the left end to x, for a step of length one: (P_(k + 1) - P_(k - 1)) /
// (4 k + 2).
void Radau::evaluate_legendre_integrals(double x) {
  const double at = 2 * x - 1;
  double previous = 1.0, current = at;
  legendre_integrals_(0) = x;
  for (int k = 1; k < stages_; ++k) {
    const double next = ((2 * k + 1) * at * current - k * previous) / (k + 1);
    legendre_integrals_(k) = (next - previous) / (4 * k + 2);
    previous = current, current = next;
  }
}

void Radau::evaluate(const Polynomial& polynomial, double t, Out y) {
  evaluate_legendre_integrals((t - polynomial.t) / polynomial.h);
  y.noalias() = polynomial.series * legendre_integrals_;
  y += polynomial.y;
}

void Radau::extrapolate(double x, double h, Out y) {
  if (last_polynomial_.h == 0.0)
    y = step_.y;
  else
    evaluate(last_polynomial_, step_.t + x * h, y);
}

void Radau::extrapolate_stages(double h) {
  for (int i = 0; i < stages_; ++i) {
    extrapolate(c_(i), h, Z_.col(i));
    Z_.col(i) -= step_.y;
  }
}

// Evaluate the Jacobian on the extrapolated last polynomial; without one, at the start of the step.
bool Radau::new_jacobian(double h) {
  for (double x : {jacobian_time, 0.0}) {
    if (x > 0.0 && last_polynomial_.h == 0.0) continue;
    if (x > 0.0)
      extrapolate(x, h, y_stage_);
    else
      y_stage_ = step_.y;
    ++work_.jacobians;
    if (system_.jacobian(step_.t + x * h, y_stage_, motion_block_.J, work_.rhs)) {
      system_.rate_pairs(motion_block_.rates), motion_block_.update_indices();
      if (Integrand* integrand = system_.integrand) {
        if (!integrand->jacobian(y_stage_, integrand_block_.J)) continue;
        integrand->rate_pairs(integrand_block_.rates), integrand_block_.update_indices();
        blocks_are_equal_ = integrand_block_.J.rows() == motion_block_.J.rows() &&
                            integrand_block_.J == motion_block_.J && integrand_block_.rates == motion_block_.rates;
      }
      jacobian_is_valid_ = jacobian_is_fresh_ = true, factorized_step_ = 0.0;
      return true;
    }
  }
  return false;
}

void Radau::Block::update_indices() {
  const auto size = static_cast<int>(J.rows());
  remaining.clear(), position.assign(static_cast<size_t>(size), 0);
  for (const auto& [i, j] : rates) position[i] = -1;
  for (int k = 0; k < size; ++k)
    if (position[k] == 0) position[k] = static_cast<int>(remaining.size()), remaining.push_back(k);
}

template <class Scalar>
void Radau::ShiftedBlock<Scalar>::compute(const Block& of, Scalar shift_) {
  shift = shift_;
  const auto m = static_cast<Eigen::Index>(of.remaining.size());
  matrix.resize(m, m), rhs.resize(m);
  for (Eigen::Index c = 0; c < m; ++c) {
    for (Eigen::Index r = 0; r < m; ++r) matrix(r, c) = -of.J(of.remaining[r], of.remaining[c]);
    matrix(c, c) += shift;
  }
  const Scalar inverse = Scalar(1.0) / shift;
  for (const auto& [i, j] : of.rates)
    for (Eigen::Index r = 0; r < m; ++r) matrix(r, of.position[j]) -= of.J(of.remaining[r], i) * inverse;
  lu.compute(matrix);
}

template <class Scalar>
void Radau::ShiftedBlock<Scalar>::solve(const Block& of, const Eigen::Ref<const Column>& b, Eigen::Ref<Column> x) {
  const auto m = static_cast<Eigen::Index>(of.remaining.size());
  const Scalar inverse = Scalar(1.0) / shift;
  for (Eigen::Index r = 0; r < m; ++r) rhs(r) = b(of.remaining[r]);
  for (const auto& [i, j] : of.rates) {
    const Scalar x_i = inverse * b(i);
    for (Eigen::Index r = 0; r < m; ++r) rhs(r) += of.J(of.remaining[r], i) * x_i;
  }
  solution = lu.solve(rhs);
  for (Eigen::Index r = 0; r < m; ++r) x(of.remaining[r]) = solution(r);
  for (const auto& [i, j] : of.rates) x(i) = (b(i) + x(j)) * inverse;
}

template <class Scalar>
void Radau::Factors<Scalar>::compute(const Radau& of, Scalar shift) {
  motion.compute(of.motion_block_, shift);
  if (of.integrand_block_.J.size() && !of.blocks_are_equal_) integrand.compute(of.integrand_block_, shift);
}

template <class Scalar>
void Radau::Factors<Scalar>::solve(const Radau& of, const Eigen::Ref<const typename ShiftedBlock<Scalar>::Column>& b,
                                   Eigen::Ref<typename ShiftedBlock<Scalar>::Column> x) {
  const auto size = of.motion_block_.J.rows(), column = of.integrand_block_.J.rows();
  motion.solve(of.motion_block_, b.head(size), x.head(size));
  for (auto k = size; k < b.size(); k += column)
    (of.blocks_are_equal_ ? motion : integrand)
        .solve(of.blocks_are_equal_ ? of.motion_block_ : of.integrand_block_, b.segment(k, column),
               x.segment(k, column));
}

void Radau::factorize(double h) {
  ++work_.factorizations;
  real_factors_.compute(*this, lambda_(0).real() / h);
  for (size_t k = 0; k < complex_factors_.size(); ++k) complex_factors_[k].compute(*this, lambda_(k + 1) / h);
  factorized_step_ = h;
}

// (A^-1 / h - J) dZ = F - A^-1 Z / h, in the eigenvectors of A^-1.
void Radau::solve_linear_system() {
  F_ -= Z_dot_;
  real_rhs_.noalias() = F_ * V_inverse_.row(0).real().transpose();
  real_factors_.solve(*this, real_rhs_, real_correction_);
  dZ_.noalias() = real_correction_ * V_.col(0).real().transpose();
  for (size_t k = 0; k < complex_factors_.size(); ++k) {
    complex_rhs_.noalias() = F_ * V_inverse_.row(k + 1).transpose();
    complex_factors_[k].solve(*this, complex_rhs_, complex_correction_);
    for (int i = 0; i < stages_; ++i) dZ_.col(i) += 2.0 * (complex_correction_ * V_(i, k + 1)).real();
  }
}

Radau::Newton Radau::iterate(double h) {
  scale_ = tolerance_.scale(step_.y, step_.y);
  if (checks_full_motion(h)) X_.resize(step_.x.size(), stages_), x_stage_.resize(step_.x.size());
  contraction_ = 0.0;
  double previous_size = 0.0;
  for (iterations_ = 1; iterations_ <= max_iterations_; ++iterations_) {
    Z_dot_.noalias() = (1.0 / h) * Z_ * A_inverse_.transpose();
    for (int i = 0; i < stages_; ++i) {
      y_stage_ = step_.y + Z_.col(i);
      if (!evaluate(step_.t + c_(i) * h, y_stage_, F_.col(i))) return must_stop() ? Newton::impossible : Newton::slow;
      if (checks_full_motion(h)) system_.full_motion(Z_dot_.col(i), x_stage_, X_.col(i));
    }
    solve_linear_system();
    double square = 0.0;
    for (int i = 0; i < stages_; ++i) square += (dZ_.col(i).array() / scale_.array()).square().sum();
    const double size = std::sqrt(square / static_cast<double>(dZ_.size()));
    if (!std::isfinite(size)) return Newton::slow;
    correction_size_ = size;
    double remaining_error = 1e3 * size;
    if (iterations_ > 1) {
      contraction_ = size / previous_size;
      if (contraction_ < 1.0) remaining_error = contraction_ / (1 - contraction_) * size;
    }
    if (iterations_ > 2 || contraction_ > max_second_correction) {
      const double predicted_error = std::pow(contraction_, max_iterations_ - iterations_) / (1 - contraction_) * size;
      if (contraction_ >= 1.0 || predicted_error > tolerance_.newton) return Newton::slow;
    }
    Z_ += dZ_;
    if (remaining_error < tolerance_.newton) return Newton::converged;
    previous_size = size;
  }
  return Newton::slow;
}

// Error estimate of order s - 1, filtered so that it stays bounded for stiff motions.
double Radau::estimate_error(const Vector& f, double h) {
  real_rhs_.noalias() = f + (1.0 / h) * Z_ * e_;
  real_factors_.solve(*this, real_rhs_, error_);
  scale_ = tolerance_.scale(step_.y, step_.y_new);
  return norm(error_, scale_) / (stages_ > 3 ? error_pessimism : 1.0);
}

bool Radau::make_step(double t_bound) {
  const double min_size = min_step_size(t_bound), exponent = -1.0 / (stages_ + 1);
  double step_size = std::clamp(step_.h, min_size, std::max(min_size, tolerance_.max_step));
  bool rejected = false;
  const auto shorten_step = [&](double factor) {
    step_size *= factor;
    rejected = true;
    ++work_.rejected;
  };
  for (;;) {
    if (!(step_size >= min_size)) return false;
    step_.t_new = std::min(step_.t + step_size, t_bound);
    const double h = step_size = step_.t_new - step_.t;
    if (!jacobian_is_valid_ && !new_jacobian(h)) {
      if (must_stop()) return false;
      last_polynomial_.h = 0.0;
      shorten_step(min_factor);
      continue;
    }
    if (factorized_step_ != h) factorize(h);
    extrapolate_stages(h);
    const Newton outcome = iterate(h);
    if (outcome == Newton::impossible) return false;
    if (outcome == Newton::slow) {
      if (jacobian_is_fresh_) {
        shorten_step(0.5);
        cautious_steps_left_ = cautious_steps;
      }
      jacobian_is_valid_ = false;
      continue;
    }
    step_.y_new = step_.y + Z_.col(stages_ - 1);
    double size = estimate_error(step_.f, h);
    if (size >= 1.0 && (rejected || error_old_ == 0.0)) {  // filter once more, with the rate at the estimated error
      y_stage_ = step_.y + error_;
      if (evaluate(step_.t, y_stage_, f_stage_)) size = estimate_error(f_stage_, h);
      if (must_stop()) return false;
    }
    const double effort = safety * (2 * max_iterations_ + 1) / (2 * max_iterations_ + iterations_);
    if (!(size < 1.0)) {
      shorten_step(std::isfinite(size) ? std::max(min_factor, effort * std::pow(size, exponent)) : min_factor);
      continue;
    }
    if (!evaluate(step_.t_new, step_.y_new, step_.f_new)) {
      if (must_stop()) return false;
      shorten_step(0.5);
      continue;
    }
    if (step_.x.size()) system_.full_motion(step_.f_new, step_.x_new, step_.x_dot_new);
    if (checks_full_motion(h)) {
      x_stage_.noalias() = h * X_ * b_;
      if (!(disagreement(x_stage_) < max_disagreement * (1.0 + correction_size_))) {
        if (!return_to_start()) return false;
        shorten_step(0.5);
        continue;
      }
    }
    propose_step_size(h, std::max(size, 1e-10), effort, exponent);
    if (step_.t_new == t_bound && !rejected) step_.h_next = std::max(step_.h_next, step_.h);
    step_polynomial_.series.noalias() = Z_ * to_series_;
    step_polynomial_.y = step_.y, step_polynomial_.t = step_.t, step_polynomial_.h = h;
    return true;
  }
}

// Next step size, from the error and its change (K. Gustafsson, 1994) and from the convergence of Newton's method.
void Radau::propose_step_size(double h, double size, double effort, double exponent) {
  double factor = std::min(max_factor, effort * std::pow(size, exponent));
  if (error_old_ > 0.0) factor = std::min(factor, effort * (h / h_old_) * std::pow(size * size / error_old_, exponent));
  if (contraction_ > slow_contraction) factor = std::min(factor, 1.0);
  if (cautious_steps_left_ > 0) factor = std::min(factor, cautious_growth);
  if (contraction_ <= refresh_contraction && factor > min_factor_kept && factor < max_factor_kept) factor = 1.0;
  step_.h_next = h * factor;
  error_new_ = std::max(size, 1e-2);
}

void Radau::reject_step(double step_size) {
  Method::reject_step(step_size);
  jacobian_is_fresh_ = false;
}

void Radau::accept_step() {
  error_old_ = error_new_, h_old_ = step_polynomial_.h;
  cautious_steps_left_ = std::max(0, cautious_steps_left_ - 1);
  std::swap(last_polynomial_, step_polynomial_);
  jacobian_is_fresh_ = false;
  if (contraction_ > refresh_contraction) jacobian_is_valid_ = false;
  Method::accept_step();
}

void Radau::reset_history() {
  last_polynomial_.h = 0.0, error_old_ = 0.0;
  jacobian_is_valid_ = jacobian_is_fresh_ = false;
}

bool Radau::interpolate(double at, Out y_at) {
  evaluate(step_polynomial_, at, y_at);
  return true;
}

}  // namespace ckc
