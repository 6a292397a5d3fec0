// Jumps of the sensitivities at events where a velocity or an acceleration jumps (saltation).
#include <algorithm>
#include <cmath>

#include <Eigen/QR>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

// Relative tolerance for comparing times of events: its bounds, and its ratio to the integration tolerance.
constexpr double min_relative_tolerance = 1e-7, max_relative_tolerance = 1e-2, tolerance_factor = 100.0;
constexpr double rate_rounding = 1e-9;  // relative to the fastest coordinate; slower coordinates are at rest

Vector Sensitivities::time_shift(const JointArrival& arrival, In v, In a, const Matrix& s) const {
  const int k = arrival.coordinate;
  if (arrival.of_rate) return -s.row(n + k) / a(k);
  return -distance_from_stop_derivative(arrival, s) / core_.tree.coordinate_change(core_.q_tree, k, v);
}

// Project the sensitivities onto the tangent space of loops and locked joints, minimum-norm in the metric of D'. They
// drift within the tolerances. Otherwise joints that move only together would stop at different times.
bool Sensitivities::project_sensitivities(In v, Matrix& s) {
  const int m = core_.constraints.closure.rows;
  const Vector none = Vector::Zero(n), no_force = Vector::Zero(m);
  const bool locked = !core_.joints.locked.empty();
  Matrix phi_dot_derivative;
  compute(v, none, no_force, false);
  closure_derivatives(v, row_, phi_dot_derivative);
  core_.compute_D_tree(), core_.compute_J();
  force_.setZero();
  row_ += core_.constraints.J() * s.topRows(n);
  if (!core_.solve_acceleration_derivatives(force_, row_, derivative_) ||
      (locked && !core_.unit_force_responses(core_.joints.locked, responses_)))
    return false;
  if (locked) add_locked_correction(derivative_);
  s.topRows(n) += derivative_;
  for (int k = 0; k < n; ++k) phi_dot_derivative += derivatives_.rate_by_q.col(table_.real_v[k]) * s.row(k);
  row_ = phi_dot_derivative + core_.constraints.J() * s.bottomRows(n);
  if (!core_.solve_acceleration_derivatives(force_, row_, derivative_)) return false;
  derivative_ += s.bottomRows(n);
  if (locked) add_locked_correction(derivative_);
  s.bottomRows(n) = derivative_;
  return true;
}

double Sensitivities::column_norm(const Eigen::Ref<const Matrix>& s, int p) const {
  const Vector& reach = core_.joints.table.reach;
  return std::max(s.col(p).head(n).cwiseQuotient(reach).lpNorm<Eigen::Infinity>(),
                  s.col(p).tail(n).cwiseQuotient(reach).lpNorm<Eigen::Infinity>());
}

void Sensitivities::record_column_sizes(const Eigen::Ref<const Matrix>& s) {
  for (int p = 0; p < count; ++p) largest_norm_(p) = std::max(largest_norm_(p), column_norm(s, p));
}

bool Sensitivities::has_defined_time(int coordinate, bool of_rate, In v, In a) const {
  const Vector& reach = core_.joints.table.reach;
  const Vector moves = (of_rate ? a : v).cwiseQuotient(reach).cwiseAbs();
  return moves(coordinate) > rate_rounding * moves.maxCoeff();
}

void Sensitivities::shift_time(In v, In a, double sign, Matrix& s) const {
  for (int k = 0; k < n; ++k) {
    s.row(k) += sign * v(k) * time_shift_.row(table_.part[k]);
    s.row(n + k) += sign * a(k) * time_shift_.row(table_.part[k]);
  }
}

// Shift the sensitivities to the time of the event, which depends on the parameters. The fastest of simultaneous
// arrivals defines the time; arrivals at stops take precedence over arrivals at rest. Unconnected parts of the
// mechanism have independent times, because the order of their events does not matter.
bool Sensitivities::before_transition(In v, In a, const std::vector<JointArrival>& arrivals, Matrix& s) {
  const Vector& reach = core_.joints.table.reach;
  const auto speed = [&](const JointArrival& of) {
    return std::abs((of.of_rate ? a : v)(of.coordinate)) / reach(of.coordinate);
  };
  const auto comes_later = [&](const JointArrival& x, const JointArrival& y) {
    return x.of_rate == y.of_rate ? speed(x) < speed(y) : x.of_rate;
  };
  previous_direction_ = core_.joints.sliding_direction, previous_stop_side_ = core_.joints.stop_side;
  was_locked_.assign(n, 0), was_struck_.assign(n, 0), unreached_rates_.clear();
  for (int k : core_.joints.locked) was_locked_[k] = 1;
  time_shift_.setZero();
  if (!project_sensitivities(v, s)) return false;
  record_column_sizes(s);
  for (Eigen::Index part = 0; part < time_shift_.rows(); ++part) {
    const JointArrival* first = nullptr;
    for (const JointArrival& of : arrivals)
      if (table_.part[of.coordinate] == part && has_defined_time(of.coordinate, of.of_rate, v, a) &&
          (!first || comes_later(*first, of)))
        first = &of;
    if (first) time_shift_.row(part) = time_shift(*first, v, a, s);
  }
  shift_time(v, a, 1.0, s);
  return s.allFinite();
}

// A joint that stays at rest while another one changes its mode, or that reverses, does not change its mode.
bool Sensitivities::mode_changed(const JointArrival& arrival) const {
  const Joints& joints = core_.joints;
  const int k = arrival.coordinate;
  const bool locked = joints.is_locked(k);
  return before_first_transition_ || was_struck_[k] || locked != static_cast<bool>(was_locked_[k]) ||
         joints.sliding_direction[k] != previous_direction_[k] || joints.stop_side[k] != previous_stop_side_[k];
}

// Tolerances are relative to the largest norm that the column has had, because digits that were lost there stay lost.
std::optional<NonDifferentiableEvent> Sensitivities::find_non_differentiable(const std::vector<JointArrival>& arrivals,
                                                                             const Matrix& s, double rtol,
                                                                             double atol) {
  const double relative = std::clamp(tolerance_factor * rtol, min_relative_tolerance, max_relative_tolerance);
  record_column_sizes(s);
  for (const auto& [k, unreached] : unreached_rates_)
    for (int p = 0; p < count; ++p)
      if (!(std::abs(unreached(p)) <=
            core_.joints.table.reach(k) * (relative * largest_norm_(p) + tolerance_factor * atol)))
        return NonDifferentiableEvent{{k, false}, p, NonDifferentiableEvent::restitution};
  if (before_first_transition_)
    for (int p = 0; p < count; ++p)
      if (const int k = table_.parameters[p].assembled_at; k >= 0) return NonDifferentiableEvent{{k, false}, p};
  for (const JointArrival& arrival : arrivals) {
    if (!mode_changed(arrival)) continue;
    const double reach = core_.joints.table.reach(arrival.coordinate);
    const Vector offset =
        (arrival.of_rate ? Vector(s.row(n + arrival.coordinate)) : distance_from_stop_derivative(arrival, s)) / reach;
    for (int p = 0; p < count; ++p)
      if (!(std::abs(offset(p)) <= relative * largest_norm_(p) + tolerance_factor * atol))
        return NonDifferentiableEvent{arrival, p};
  }
  return {};
}

std::optional<NonDifferentiableEvent> Sensitivities::find_marginally_locked(double atol) {
  const Joints& joints = core_.joints;
  std::vector<char> before(n, 0);
  std::swap(before, was_at_limit_);
  before.resize(n, 0);
  std::optional<NonDifferentiableEvent> first;
  for (int i : core_.find_joints_at_force_limit()) {
    const int k = joints.locked[i];
    was_at_limit_[k] = 1;
    if (!before[k] || first) continue;
    const Vector& reach = joints.table.reach;
    for (int p = 0; p < count && !first; ++p) {
      const double largest = free_derivative_.col(p).cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
      const double side = joints.stop_side[k] ? joints.stop_side[k] : std::copysign(1.0, joints.holding_forces()(i));
      // derivative of the distance from the limit, N or N m
      double margin_derivative = -side * locked_force_derivative_(i, p);
      for (const ParameterDerivative& of : table_.parameters[p].derivatives)
        if (of.kind == ParameterDerivative::friction && of.index == k) margin_derivative += 1.0;
      if (std::abs(responses_(k, i) * margin_derivative) >
          reach(k) * (min_relative_tolerance * largest + tolerance_factor * atol))
        first = NonDifferentiableEvent{{k, true, joints.stop_side[k]}, p, NonDifferentiableEvent::marginally_locked};
    }
  }
  return first;
}

// A joint that sticks or touches from here on is stopped by its holding force at any parameter value. For other
// values a short slide or a series of ever smaller bounces may come first. Its time and distance vanish with the
// arrival rate.
void Sensitivities::after_transition(In v, In a, Matrix& s) {
  was_at_limit_.clear();
  torque_limit_side_.clear();  // torques may jump together with the velocity
  before_first_transition_ = false;
  shift_time(v, a, -1.0, s);
}

// D' step = J^T mu + x and J step = 0. The speeds that the impulses x reverse keep their ratio to the approach
// speeds.
bool Sensitivities::at_impact(In v, In step, const Indices& at, const Matrix& responses, In x, double restitution,
                              Matrix& s) {
  const int m = core_.constraints.closure.rows;
  const Vector none = Vector::Zero(n);
  Vector lambda = Vector::Zero(m), residual_force(n);
  core_.compute_D_tree();
  core_.multiply_D_tree(step, residual_force);
  Indices active_stops;
  for (size_t i = 0; i < at.size(); ++i) {
    const auto k = static_cast<Eigen::Index>(i);
    residual_force(at[i]) -= x(k);
    was_struck_[at[i]] = 1;
    // A stop is active if it pushes. Either its impulse or its deviation from the restitution law is rounding; a
    // comparison tells which. A reversed joint is active too, even if joints that move only with it take the impulse.
    const double before = v(at[i]), after = before + step(at[i]);
    const double deviation = std::abs(after + restitution * before);
    const bool reversed = has_defined_time(at[i], false, v, v) && before * step(at[i]) < 0.0;
    if (std::abs(x(k)) * responses(at[i], k) > deviation || (reversed && deviation <= rate_rounding * std::abs(before)))
      active_stops.push_back(static_cast<int>(i));
  }
  core_.minimum_norm_multipliers(residual_force, lambda);
  compute(none, step, lambda, true);
  force_.setZero(n, count), row_.setZero(m, count);
  add_parameters(none, step, lambda, true, force_, row_);
  Matrix positions = s;
  positions.bottomRows(n).setZero();
  add_state_derivatives(positions);
  if (!core_.solve_acceleration_derivatives(-force_, row_, derivative_)) return false;
  const auto active_count = static_cast<Eigen::Index>(active_stops.size());
  Matrix A(active_count, active_count), target_rates(active_count, count), columns(n, active_count);
  Vector scale(active_count);
  for (Eigen::Index i = 0; i < active_count; ++i) {
    const int k = at[active_stops[i]];
    columns.col(i) = responses.col(active_stops[i]);
    for (Eigen::Index j = 0; j < active_count; ++j) A(i, j) = responses(k, active_stops[j]);
    scale(i) = 1.0 / std::sqrt(A(i, i));
    // direction away from the stop
    const double side = x(active_stops[i]) > 0.0 || (x(active_stops[i]) == 0.0 && v(k) < 0.0) ? 1.0 : -1.0;
    target_rates.row(i) = -(1.0 + restitution) * s.row(n + k) - derivative_.row(k);
    for (int p = 0; p < count; ++p)
      for (const ParameterDerivative& of : table_.parameters[p].derivatives)
        if (of.kind == ParameterDerivative::restitution && of.index == k &&
            restitution == core_.joints.table.restitution(k))
          target_rates(i, p) += side * std::max(-side * v(k), 0.0);
  }
  A = scale.asDiagonal() * A * scale.asDiagonal(), target_rates = scale.asDiagonal() * target_rates;
  Eigen::CompleteOrthogonalDecomposition<Matrix> solver(active_count, active_count);
  solver.setThreshold(dependent_row_tolerance).compute(A);
  const Matrix impulse = solver.solve(target_rates);
  s.bottomRows(n) += derivative_ + columns * scale.asDiagonal() * impulse;
  // Nonzero if joints that move only together are reflected by different stops: after a small change of a restitution,
  // another stop would determine the motion.
  const Matrix unreached = scale.cwiseInverse().asDiagonal() * (A * impulse - target_rates);
  for (Eigen::Index i = 0; i < active_count; ++i) unreached_rates_.emplace_back(at[active_stops[i]], unreached.row(i));
  return s.allFinite();
}

}  // namespace ckc
