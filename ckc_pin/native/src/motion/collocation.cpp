#include "motion/collocation.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "motion/legendre.hpp"

namespace ckc {

// Accepted error of a polynomial of lower degree, and of the iteration, relative to |y|.
constexpr double max_relative_error = 1e-9;
constexpr int error_order = 12;  // observed order of the error in the step size
// Tolerances of the fixed-point iteration on the stages, relative to |y|: for the step itself the smaller of a part of
// its accepted error and a part of rtol, and for the step from which the initial guess is extrapolated.
constexpr double part_of_error = 0.1, part_of_rtol = 1e-3, guess_tolerance = 1e-4;
constexpr int max_sweeps = 30;
constexpr double run_up_fraction = 0.4;   // part of the step that is integrated first, as a guess for the rest
constexpr double max_guess_error = 0.03;  // relative to |y|; with a larger error of the guess the step is rejected
constexpr double predicted_error_factor = 1e-6;  // observed error of such a step, relative to the error of its guess
constexpr int points_of_rest = 41;  // at which the terms of the highest degrees are evaluated
constexpr double infinity = std::numeric_limits<double>::infinity();

Collocation::Table::Table(int s)
    : nodes(gauss_nodes(s)), differentiation(legendre_derivative_matrix(s).transpose()) {
  Matrix integral = Matrix::Zero(s + 1, s);  // of each polynomial
  integral(0, 0) = integral(1, 0) = 1.0;
  for (int k = 1; k < s; ++k) integral(k + 1, k) = 1.0 / (2 * k + 1), integral(k - 1, k) = -1.0 / (2 * k + 1);
  integration = integral * Matrix(legendre_values(nodes, s).transpose()).inverse();
  integration_at_nodes = legendre_values(nodes, s + 1).transpose() * integration;
}

Collocation::Collocation(System& system, Work& work, const Tolerance& tolerance, int stages, int run_up_stages)
    : system_(system),
      work_(work),
      tolerance_(tolerance),
      table_(stages),
      run_up_(run_up_stages),
      is_integrated_twice_(system.size, false) {
  const Vector points = Vector::LinSpaced(points_of_rest, -1.0, 1.0);
  rest_at_points_ = legendre_values(points, stages + 1).bottomRows(stages - run_up_stages).transpose();
  state_.setZero(system.size), rate_.setZero(system.size);
  system.rate_pairs(rate_pairs_);
  for (const auto& pair : rate_pairs_) is_integrated_twice_[static_cast<size_t>(pair.first)] = true;
}

static double largest_entry(const Matrix& a) { return a.cwiseAbs().maxCoeff<Eigen::PropagateNaN>(); }

bool Collocation::is_accurate() const { return error <= max_relative_error; }

double Collocation::step_scale() const {
  return 0.9 * std::pow(max_relative_error / std::max(error, 1e-300), 1.0 / error_order);
}

void Collocation::evaluate(double t_, Out y) const {
  Vector x(1);
  x(0) = (2 * t_ - t_old - t) / (t - t_old);
  y = series_.transpose() * legendre_values(x, series_.rows());
}

void Collocation::make_step(double t_, In y, double span, bool is_repeat) {
  const double length = is_repeat ? t - t_old : run_up_fraction * span,
               size = std::max(1.0, y.lpNorm<Eigen::Infinity>());
  t_old = t_, t = t_ + span, y_ = y;
  if (!is_repeat) {
    if (!evaluate_rate(t_old, y_, rate_)) rate_.setConstant(std::nan(""));
    guess_ = rate_.transpose().replicate(run_up_.nodes.size(), 1);
    solve_stages(run_up_, length, guess_tolerance * size, infinity);
  }
  extrapolate_guess(length, span / length);
  const double step_tolerance = std::min(part_of_error * max_relative_error, part_of_rtol * tolerance_.rtol),
               guess_error = solve_stages(table_, span, step_tolerance * size, max_guess_error * size);
  if (!(guess_error <= max_guess_error * size)) {
    error = std::isfinite(guess_error) ? predicted_error_factor * guess_error / size : infinity;
    return;
  }
  const double rest = largest_entry(rest_at_points_ * series_.bottomRows(rest_at_points_.cols()));
  error = std::isfinite(rest + iteration_error_) ? std::max(rest, iteration_error_) / size : infinity;
}

// Solve for the stages by fixed-point iteration from guess_; the solution is series_. Return the change of y in the
// first sweep.
double Collocation::solve_stages(const Table& table, double span, double tolerance, double max_first_change) {
  double guess_error = std::nan(""), previous_change = infinity, contraction = 1.0;
  const auto pairs = static_cast<Eigen::Index>(rate_pairs_.size());
  rate_corrections_.setZero(table.nodes.size(), pairs);
  integrate(table, span);
  for (int sweep = 0; sweep < max_sweeps && states_.allFinite(); ++sweep) {
    evaluate_rates(table.nodes, span);
    const double sweep_change = largest_entry(rates_ - guess_) * span;
    if (sweep == 0) guess_error = sweep_change;
    contraction = sweep ? sweep_change / previous_change : 1.0;
    guess_ = rates_;
    for (Eigen::Index k = 0; k < pairs; ++k)
      rate_corrections_.col(k) = rates_.col(rate_pairs_[k].first) - states_.col(rate_pairs_[k].second);
    last_states_ = states_;
    integrate(table, span);
    iteration_error_ = contraction * largest_entry(states_ - last_states_);
    // The iteration has converged, diverges, or has converged to rounding.
    if (iteration_error_ <= tolerance || !(sweep_change < 0.5 * previous_change) || guess_error > max_first_change)
      break;
    previous_change = sweep_change;
  }
  series_.noalias() = (0.5 * span) * table.integration * guess_;
  series_.row(0) += y_.transpose();
  return guess_error;
}

// Integrate guess_ to the states at the stages. Coordinates are integrated from the velocities that the accelerations
// give, which halves the number of sweeps.
void Collocation::integrate(const Table& table, double span) {
  states_.resizeLike(guess_);
  const auto integrate_entry = [&](int i) {
    states_.col(i) = (0.5 * span) * table.integration_at_nodes.lazyProduct(guess_.col(i));
    states_.col(i).array() += y_(i);
  };
  for (int i = 0; i < system_.size; ++i)
    if (!is_integrated_twice_[static_cast<size_t>(i)]) integrate_entry(i);
  for (size_t k = 0; k < rate_pairs_.size(); ++k) {
    const auto [i, j] = rate_pairs_[k];
    guess_.col(i) = states_.col(j) + rate_corrections_.col(static_cast<Eigen::Index>(k));
    integrate_entry(i);
  }
}

bool Collocation::evaluate_rate(double t, In y, Out y_dot) {
  return work_.count_rhs() && system_.rate_on_manifold(t, y, y_dot);
}

// Evaluate y' at the stages; NaN where it does not exist.
void Collocation::evaluate_rates(const Vector& nodes, double span) {
  rates_.resizeLike(guess_);
  for (Eigen::Index k = 0; k < nodes.size(); ++k) {
    state_ = states_.row(k);
    if (!evaluate_rate(t_old + span * (1 + nodes(k)) / 2, state_, rate_)) rate_.setConstant(std::nan(""));
    rates_.row(k) = rate_;
  }
}

// Set guess_ to the rates of series_, extrapolated to a step that is `ratio` times as long.
void Collocation::extrapolate_guess(double length, double ratio) {
  const Table& table_of_series = series_.rows() == run_up_.nodes.size() + 1 ? run_up_ : table_;
  const Vector x = (1 + table_.nodes.array()) * ratio - 1;
  guess_ = (2 / length) * legendre_values(x, table_of_series.nodes.size()).transpose() *
           (table_of_series.differentiation * series_);
}

}  // namespace ckc
