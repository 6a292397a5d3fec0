#include "motion/radau.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

#include "motion/legendre.hpp"

namespace ckc {

constexpr double min_factor = 0.2, max_factor = 8.0, safety = 0.9;
// The second correction may be so much larger than the first: what stiff control does to q, the first passes on to z.
constexpr double second = 2.0;
constexpr double ahead = 0.8;             // of a step: where the Jacobian is taken
constexpr double refresh = 0.02;          // contraction of Newton's method from which the Jacobian is taken anew
constexpr double keep_from = 0.9, keep_to = 1.2;  // factors of the length for which new factors do not pay
constexpr double pessimism = 3.0;  // of the error's estimate, with five stages or more; with three it is what it says
// How far z may be from what its rates add up to, relative to the error: the rates are those before the last correction.
constexpr double agreement = 10.0;
constexpr int cautious_steps = 3;  // after Newton's method has failed, and how much they may grow
constexpr double cautious_growth = 1.5, slow_contraction = 0.3;

// A Newton iteration that is to come closer is given as many more; each gains a digit or so.
static int iterations_for(int stages, double newton) { return (stages == 7 ? 8 : 6) + std::max(0, int(-std::log10(newton))); }

static int stages_for(double rtol) { return rtol >= 1e-3 ? 3 : rtol > 1e-8 ? 5 : 7; }

Radau::Radau(System& system, Step& step, Work& work, const Tolerance& tolerance)
    : Method(system, step, work, tolerance), stages_(stages_for(tolerance.rtol)), most_iterations_(iterations_for(stages_, tolerance.newton)) {
  const int n = system.size, s = stages_;
  tabulate();
  Z_dot_.setZero(n, s), Z_.setZero(n, s), F_.setZero(n, s), dZ_.setZero(n, s);
  for (Vector* x : {&scale_, &error_, &y_stage_, &f_stage_, &real_right_, &real_correction_}) x->setZero(n);
  right_.setZero(n), correction_.setZero(n);
  pairs_.resize(s / 2);
  for (Polynomial* p : {&last_, &made_}) p->series.setZero(n, s), p->y.setZero(n);
}

// Nodes are the zeros of P_s - P_(s - 1), the right end among them; everything else follows from them.
void Radau::tabulate() {
  const int s = stages_;
  const Vector nodes = radau_nodes(s);
  c_ = (1.0 + nodes.array()) / 2;
  basis_.setZero(s);
  Matrix integral(s, s);
  for (int i = 0; i < s; ++i) integrals(c_(i)), integral.row(i) = basis_.transpose();
  A_inverse_ = legendre(nodes, s).transpose() * integral.inverse();
  b_ = legendre(nodes, s).partialPivLu().solve(integral.row(s - 1).transpose());
  to_series_ = integral.inverse().transpose();  // acts from the right
  // f(t, y) + sum of e_i z_i / h vanishes for polynomials up to degree s
  e_ = integral.transpose().partialPivLu().solve(-legendre(Vector::Constant(1, -1.0), s).col(0));
  const Eigen::EigenSolver<Matrix> eigen(A_inverse_);
  const Eigen::MatrixXcd inverse = eigen.eigenvectors().inverse();
  lambda_.resize(s / 2 + 1), V_.resize(s, s / 2 + 1), V_inverse_.resize(s / 2 + 1, s);
  int pair = 0;
  for (int k = 0; k < s; ++k) {
    const double imaginary = eigen.eigenvalues()(k).imag();
    if (imaginary < 0) continue;
    const int at = imaginary == 0 ? 0 : ++pair;  // the real one first
    lambda_(at) = eigen.eigenvalues()(k), V_.col(at) = eigen.eigenvectors().col(k), V_inverse_.row(at) = inverse.row(k);
  }
}

// Of Legendre's polynomials from the left end to x, in lengths of a step: (P_(k + 1) - P_(k - 1)) / (4 k + 2).
void Radau::integrals(double x) {
  const double at = 2 * x - 1;
  double before = 1.0, here = at;
  basis_(0) = x;
  for (int k = 1; k < stages_; ++k) {
    const double next = ((2 * k + 1) * at * here - k * before) / (k + 1);
    basis_(k) = (next - before) / (4 * k + 2);
    before = here, here = next;
  }
}

void Radau::evaluate(const Polynomial& polynomial, double t, Out y) {
  integrals((t - polynomial.t) / polynomial.h);
  y.noalias() = polynomial.series * basis_;
  y += polynomial.y;
}

void Radau::extrapolate(double x, double h, Out y) {
  if (last_.h == 0.0)
    y = step_.y;
  else
    evaluate(last_, step_.t + x * h, y);
}

void Radau::guess(double h) {
  for (int i = 0; i < stages_; ++i) {
    extrapolate(c_(i), h, Z_.col(i));
    Z_.col(i) -= step_.y;
  }
}

// Where the last step's polynomial leads, or if there is nothing where the step begins.
bool Radau::new_jacobian(double h) {
  for (double x : {ahead, 0.0}) {
    if (x > 0.0 && last_.h == 0.0) continue;
    if (x > 0.0)
      extrapolate(x, h, y_stage_);
    else
      y_stage_ = step_.y;
    ++work_.jacobians;
    if (system_.jacobian(step_.t + x * h, y_stage_, motion_.J, work_.rhs)) {
      J_known_ = J_fresh_ = true, factorized_ = 0.0;
      system_.rates(motion_.rates), motion_.begin();
      if (const Matrix* J = system_.beside_jacobian()) {
        beside_.J = *J, system_.beside_rates(beside_.rates), beside_.begin();
        alike_ = beside_.J.rows() == motion_.J.rows() && beside_.J == motion_.J && beside_.rates == motion_.rates;
      }
      return true;
    }
  }
  return false;
}

void Radau::Block::begin() {
  const auto size = static_cast<int>(J.rows());
  rest.clear(), place.assign(static_cast<size_t>(size), 0);
  for (const auto& [i, j] : rates) place[i] = -1;
  for (int k = 0; k < size; ++k)
    if (place[k] == 0) place[k] = static_cast<int>(rest.size()), rest.push_back(k);
}

template <class Scalar>
void Radau::Shifted<Scalar>::compute(const Block& of, Scalar shift_) {
  shift = shift_;
  const auto m = static_cast<Eigen::Index>(of.rest.size());
  left.resize(m, m), rest.resize(m);
  for (Eigen::Index c = 0; c < m; ++c) {
    for (Eigen::Index r = 0; r < m; ++r) left(r, c) = -of.J(of.rest[r], of.rest[c]);
    left(c, c) += shift;
  }
  const Scalar inverse = Scalar(1.0) / shift;
  for (const auto& [i, j] : of.rates)
    for (Eigen::Index r = 0; r < m; ++r) left(r, of.place[j]) -= of.J(of.rest[r], i) * inverse;
  lu.compute(left);
}

template <class Scalar>
void Radau::Shifted<Scalar>::solve(const Block& of, const Eigen::Ref<const Column>& b, Eigen::Ref<Column> x) {
  const auto m = static_cast<Eigen::Index>(of.rest.size());
  const Scalar inverse = Scalar(1.0) / shift;
  for (Eigen::Index r = 0; r < m; ++r) rest(r) = b(of.rest[r]);
  for (const auto& [i, j] : of.rates) {
    const Scalar x_i = inverse * b(i);
    for (Eigen::Index r = 0; r < m; ++r) rest(r) += of.J(of.rest[r], i) * x_i;
  }
  right = lu.solve(rest);
  for (Eigen::Index r = 0; r < m; ++r) x(of.rest[r]) = right(r);
  for (const auto& [i, j] : of.rates) x(i) = (b(i) + x(j)) * inverse;
}

template <class Scalar>
void Radau::Factors<Scalar>::compute(const Radau& of, Scalar shift) {
  motion.compute(of.motion_, shift);
  if (of.beside_.J.size() && !of.alike_) beside.compute(of.beside_, shift);
}

template <class Scalar>
void Radau::Factors<Scalar>::solve(const Radau& of, const Eigen::Ref<const typename Shifted<Scalar>::Column>& b,
                                   Eigen::Ref<typename Shifted<Scalar>::Column> x) {
  const auto size = of.motion_.J.rows(), column = of.beside_.J.rows();
  motion.solve(of.motion_, b.head(size), x.head(size));
  for (auto k = size; k < b.size(); k += column)
    (of.alike_ ? motion : beside).solve(of.alike_ ? of.motion_ : of.beside_, b.segment(k, column), x.segment(k, column));
}

void Radau::factorize(double h) {
  ++work_.factorizations;
  real_.compute(*this, lambda_(0).real() / h);
  for (size_t k = 0; k < pairs_.size(); ++k) pairs_[k].compute(*this, lambda_(k + 1) / h);
  factorized_ = h;
}

// (A^-1 / h - J) dZ = F - A^-1 Z / h, in the eigenvectors of A^-1.
void Radau::solve() {
  F_ -= Z_dot_;
  real_right_.noalias() = F_ * V_inverse_.row(0).real().transpose();
  real_.solve(*this, real_right_, real_correction_);
  dZ_.noalias() = real_correction_ * V_.col(0).real().transpose();
  for (size_t k = 0; k < pairs_.size(); ++k) {
    right_.noalias() = F_ * V_inverse_.row(k + 1).transpose();
    pairs_[k].solve(*this, right_, correction_);
    for (int i = 0; i < stages_; ++i) dZ_.col(i) += 2.0 * (correction_ * V_(i, k + 1)).real();
  }
}

Radau::Newton Radau::newton(double h) {
  scale_ = tolerance_.between(step_.y, step_.y);
  if (whole(h)) X_.resize(step_.x.size(), stages_), x_stage_.resize(step_.x.size());
  contraction_ = 0.0;
  double before = 0.0;
  for (iterations_ = 1; iterations_ <= most_iterations_; ++iterations_) {
    Z_dot_.noalias() = (1.0 / h) * Z_ * A_inverse_.transpose();
    for (int i = 0; i < stages_; ++i) {
      y_stage_ = step_.y + Z_.col(i);
      if (!evaluate(step_.t + c_(i) * h, y_stage_, F_.col(i))) return over() ? Newton::impossible : Newton::slow;
      if (whole(h)) system_.whole(Z_dot_.col(i), x_stage_, X_.col(i));
    }
    solve();
    double square = 0.0;
    for (int i = 0; i < stages_; ++i) square += (dZ_.col(i).array() / scale_.array()).square().sum();
    const double size = std::sqrt(square / static_cast<double>(dZ_.size()));
    if (!std::isfinite(size)) return Newton::slow;
    correction_size_ = size;
    double left = 1e3 * size;
    if (iterations_ > 1) {
      contraction_ = size / before;
      if (contraction_ < 1.0) left = contraction_ / (1 - contraction_) * size;
    }
    if (iterations_ > 2 || contraction_ > second) {
      const double foreseen = std::pow(contraction_, most_iterations_ - iterations_) / (1 - contraction_) * size;
      if (contraction_ >= 1.0 || foreseen > tolerance_.newton) return Newton::slow;
    }
    Z_ += dZ_;
    if (left < tolerance_.newton) return Newton::converged;
    before = size;
  }
  return Newton::slow;
}

// Of order one less than the number of stages; filtered, so that it is bounded where the motion is stiff.
double Radau::error(const Vector& f, double h) {
  real_right_.noalias() = f + (1.0 / h) * Z_ * e_;
  real_.solve(*this, real_right_, error_);
  scale_ = tolerance_.between(step_.y, step_.y_new);
  return norm(error_, scale_) / (stages_ > 3 ? pessimism : 1.0);
}

bool Radau::step(double t_bound) {
  const double least = shortest(t_bound), exponent = -1.0 / (stages_ + 1);
  double length = std::clamp(step_.h, least, std::max(least, tolerance_.max_step));
  bool refused = false;
  const auto shorten = [&](double factor) {
    length *= factor;
    refused = true;
    ++work_.rejected;
  };
  for (;;) {
    if (!(length >= least)) return false;
    step_.t_new = std::min(step_.t + length, t_bound);
    const double h = length = step_.t_new - step_.t;
    if (!J_known_ && !new_jacobian(h)) {
      if (over()) return false;
      last_.h = 0.0;
      shorten(min_factor);
      continue;
    }
    if (factorized_ != h) factorize(h);
    guess(h);
    const Newton outcome = newton(h);
    if (outcome == Newton::impossible) return false;
    if (outcome == Newton::slow) {
      if (J_fresh_) {
        shorten(0.5);
        cautious_ = cautious_steps;
      }
      J_known_ = false;
      continue;
    }
    step_.y_new = step_.y + Z_.col(stages_ - 1);
    double size = error(step_.f, h);
    if (size >= 1.0 && (refused || error_old_ == 0.0)) {  // once more with the rate at what the error leads to
      y_stage_ = step_.y + error_;
      if (evaluate(step_.t, y_stage_, f_stage_)) size = error(f_stage_, h);
      if (over()) return false;
    }
    const double effort = safety * (2 * most_iterations_ + 1) / (2 * most_iterations_ + iterations_);
    if (!(size < 1.0)) {
      shorten(std::isfinite(size) ? std::max(min_factor, effort * std::pow(size, exponent)) : min_factor);
      continue;
    }
    if (!evaluate(step_.t_new, step_.y_new, step_.f_new)) {
      if (over()) return false;
      shorten(0.5);
      continue;
    }
    if (step_.x.size()) system_.whole(step_.f_new, step_.x_new, step_.x_dot_new);
    if (whole(h)) {
      x_stage_.noalias() = h * X_ * b_;
      if (!(disagreement(x_stage_) < agreement * (1.0 + correction_size_))) {
        if (!return_to_start()) return false;
        shorten(0.5);
        continue;
      }
    }
    propose(h, std::max(size, 1e-10), effort, exponent);
    if (step_.t_new == t_bound && !refused) step_.h_next = std::max(step_.h_next, step_.h);
    made_.series.noalias() = Z_ * to_series_;
    made_.y = step_.y, made_.t = step_.t, made_.h = h;
    return true;
  }
}

// The next length: as the error and its change ask for, after K. Gustafsson, 1994, and as Newton's method allows.
void Radau::propose(double h, double size, double effort, double exponent) {
  double factor = std::min(max_factor, effort * std::pow(size, exponent));
  if (error_old_ > 0.0)
    factor = std::min(factor, effort * (h / length_old_) * std::pow(size * size / error_old_, exponent));
  if (contraction_ > slow_contraction) factor = std::min(factor, 1.0);
  if (cautious_ > 0) factor = std::min(factor, cautious_growth);
  if (contraction_ <= refresh && factor > keep_from && factor < keep_to) factor = 1.0;
  step_.h_next = h * factor;
  error_new_ = std::max(size, 1e-2);
}

void Radau::retry(double length) {
  Method::retry(length);
  J_fresh_ = false;
}

void Radau::commit() {
  error_old_ = error_new_, length_old_ = made_.h;
  cautious_ = std::max(0, cautious_ - 1);
  std::swap(last_, made_);
  J_fresh_ = false;
  if (contraction_ > refresh) J_known_ = false;
  Method::commit();
}

void Radau::forget() {
  last_.h = 0.0, error_old_ = 0.0;
  J_known_ = J_fresh_ = false;
}

bool Radau::between(double at, Out y_at) {
  evaluate(made_, at, y_at);
  return true;
}

}  // namespace ckc
