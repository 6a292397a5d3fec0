#include "motion/joint_mode_transitions.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Eigenvalues>

#include "loops/box_constrained.hpp"
#include "motion/impact.hpp"

namespace ckc {

constexpr double infinity = std::numeric_limits<double>::infinity();
// Rounding of rates, relative to the largest; of coordinates in rad, or relative to the mechanism's size.
constexpr double rate_rounding = 1e-11;
// Reduction of the force bounds after a holding force was exceeded, relative to the largest force.
constexpr double holding_reduction = 1e-6;
// Response of a joint, relative to its response without loops, below which the loops block it.
constexpr double min_mobility = 1e-12;
// Relative to the acceleration that friction alone would cause: smallest scale of accelerations, and their rounding.
constexpr double friction_scale_factor = 1e-6, friction_rounding_factor = 1e-8;
constexpr double stop_offset_factor = 4.0;  // smallest rise of a bounce, relative to the joint's distance from its stop
constexpr double acceleration_tolerance = 1e-9;  // relative to the largest acceleration

static bool contains(const Indices& list, int k) { return std::find(list.begin(), list.end(), k) != list.end(); }

JointModeTransitions::JointModeTransitions(System& system, double min_rise, const Tolerance& tolerance)
    : system_(system), core_(system.core), joints_(system.core.joints), min_rise_(min_rise), tolerance_(tolerance) {
  const int n = core_.n;
  for (Vector* x : {&coordinates, &v_, &a_, &held_acceleration_, &rest_speed_, &step_}) x->setZero(n);
  nearby_stop_.assign(n, 0);
}

void JointModeTransitions::reset() { was_decided_ = false; }

bool JointModeTransitions::sync_state(double t, Out y) {
  if (!system_.sync_core(t, y)) return false;
  system_.write_projected_state(y);
  core_.tree.to_coordinates(core_.q_tree, coordinates);
  v_ = system_.velocity;
  return true;
}

bool JointModeTransitions::update(double t, Out y, const std::vector<Event>& triggered, double time_tolerance) {
  if (!sync_state(t, y)) return false;
  const Vector& reach = joints_.table.reach;
  joints_.account_friction_work(coordinates);
  // Events are located within a tolerance, so joints that come to rest or reach a stop at the same instant may still
  // be slightly off.
  rest_speed_ = rate_rounding * v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>() * reach;
  if (was_decided_ && time_tolerance > 0.0) {
    if (!system_.acceleration(t, a_)) return false;
    rest_speed_ += time_tolerance * a_.cwiseAbs();
  }
  nearby_stop_ = joints_.stop_side;
  holding_was_exceeded_ = false, first_bounce_duration = infinity;
  for (int k = 0; k < core_.n; ++k)
    for (int side : {-1, 1}) {
      const double offset = std::abs(coordinates(k) - joints_.stop_at(k, side));
      if (offset <= rate_rounding * reach(k) + time_tolerance * std::abs(v_(k))) nearby_stop_[k] = side;
    }
  for (const Event& event : triggered) {
    const int k = event.coordinate;
    if (event.quantity == Event::q_dot) rest_speed_(k) = infinity;
    if (event.quantity == Event::q) nearby_stop_[k] = event.value == joints_.table.lower(k) ? -1 : 1;
    holding_was_exceeded_ |= event.quantity == Event::holding_margin;
  }
  for (int k : joints_.locked) rest_speed_(k) = infinity;
  const Indices held = joints_.locked;
  arrivals_.clear();
  const Indices previous_direction = joints_.sliding_direction;
  if (!was_decided_)
    for (int k = 0; k < core_.n; ++k)
      if (joints_.has_friction_at(k) && !is_at_rest(k)) joints_.sliding_direction[k] = v_(k) > 0.0 ? 1 : -1;
  Integrand* const integrand = system_.integrand;
  if (integrand && !integrand->before_transition(t, y, find_arrivals(triggered))) return false;
  joints_.sliding_direction = previous_direction;
  joints_.rate_rounding = rate_rounding * v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  std::optional<double> energy;
  if (!resolve_impacts(t, y, energy) || !resolve_holding(t, y, held)) return false;
  // Kinetic energy lost in the rounds of the impact, and when rates within rounding are set to zero afterwards.
  if (energy) joints_.impact_loss += *energy - core_.energy(v_, step_).kinetic;
  was_decided_ = true;
  return !integrand || integrand->after_transition(t, y, arrivals_, tolerance_.rtol, tolerance_.atol);
}

// An exceeded holding force is no arrival, because it changes no velocity. A joint that rests at its stop without being
// held there arrives at rest.
std::vector<JointArrival> JointModeTransitions::find_arrivals(const std::vector<Event>& triggered) const {
  std::vector<JointArrival> arrivals;
  for (int k = 0; k < core_.n; ++k)
    if (approaches_stop(k)) arrivals.push_back({k, false, nearby_stop_[k]});
  for (const Event& event : triggered) {
    const int k = event.coordinate;
    if (event.quantity == Event::q_dot) arrivals.push_back({k, true});
    if (event.quantity != Event::q || approaches_stop(k)) continue;
    if (!is_at_rest(k))
      arrivals.push_back({k, false, nearby_stop_[k]});
    else if (!joints_.is_locked(k))
      arrivals.push_back({k, true});
  }
  return arrivals;
}

bool JointModeTransitions::was_reflected(int k) const {
  return std::any_of(arrivals_.begin(), arrivals_.end(), [&](const auto& of) { return of.coordinate == k && of.stop; });
}

bool JointModeTransitions::keep_movable(Indices& candidates) {
  if (!core_.unit_force_responses(candidates, responses_)) return false;
  Eigen::Index kept = 0;
  for (size_t i = 0; i < candidates.size(); ++i) {
    const int k = candidates[i];
    const auto column = static_cast<Eigen::Index>(i);
    if (!(responses_(k, column) * core_.joint_inertia(k) > min_mobility)) continue;
    candidates[kept] = k;
    if (kept != column) responses_.col(kept) = responses_.col(column);
    ++kept;
  }
  candidates.resize(kept);
  return true;
}

void JointModeTransitions::scale_responses(const Indices& candidates) {
  const auto m = static_cast<Eigen::Index>(candidates.size());
  A_.resize(m, m), scale_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) scale_(i) = 1.0 / std::sqrt(responses_(candidates[i], i));
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j) A_(i, j) = scale_(i) * scale_(j) * responses_(candidates[i], j);
}

// Resolve impacts at the nearby stops (motion/impact.hpp). Joints that touch take part, since they may be pushed.
// Friction is bounded and has no impulse, so sticking joints are released.
bool JointModeTransitions::resolve_impacts(double t, Out y, std::optional<double>& energy) {
  Indices candidates;
  bool approaches_any = false;
  for (int k = 0; k < core_.n; ++k)
    if (nearby_stop_[k]) candidates.push_back(k), approaches_any |= approaches_stop(k);
  if (!approaches_any) return true;
  energy = core_.energy(v_, step_).kinetic;
  if (!system_.acceleration(t, held_acceleration_)) return false;
  joints_.locked.clear();
  const Indices previous_stop_side = std::exchange(joints_.stop_side, Indices(core_.n, 0));
  if (!system_.acceleration(t, a_) || !keep_movable(candidates)) return false;
  const auto m = static_cast<Eigen::Index>(candidates.size());
  if (!m) return joints_.stop_side = previous_stop_side, true;
  const Vector& reach = joints_.table.reach;
  // Acceleration towards the stop, with or without the other holding forces. A bounce that does not rise in either
  // case is suppressed.
  const auto return_acceleration = [&](int k) {
    return std::max(nearby_stop_[k] * a_(k), nearby_stop_[k] * held_acceleration_(k));
  };
  const double fastest_rate = v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  ImpactProblem problem;
  problem.A.resize(m, m), problem.gap_rates.resize(m), problem.restitution.resize(m), problem.rest_speed.resize(m),
      problem.min_bounce_speed.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) {
    const int k = candidates[i], side = -nearby_stop_[k];
    problem.gap_rates(i) = side * v_(k);
    problem.restitution(i) = joints_.table.restitution(k);
    problem.rest_speed(i) = std::isfinite(rest_speed_(k)) ? rest_speed_(k) : rate_rounding * fastest_rate * reach(k);
    // A bounce must exceed the present distance from the stop, or its return cannot be detected.
    const double min_rise = std::max(
        min_rise_ * reach(k), stop_offset_factor * std::abs(coordinates(k) - joints_.stop_at(k, nearby_stop_[k])));
    problem.min_bounce_speed(i) = std::sqrt(2 * std::max(return_acceleration(k), 0.0) * min_rise);
    for (Eigen::Index j = 0; j < m; ++j) problem.A(i, j) = side * -nearby_stop_[candidates[j]] * responses_(k, j);
  }
  std::vector<char> was_hit(candidates.size(), 0);
  Vector step = Vector::Zero(core_.n);
  const auto apply = [&](const Indices& stops, const Vector& impulses, double restitution) {
    const auto count = static_cast<Eigen::Index>(stops.size());
    Indices struck_joints;
    Vector x(count);
    step_.setZero();
    for (Eigen::Index j = 0; j < count; ++j) {
      const int i = stops[j], k = candidates[i];
      struck_joints.push_back(k);
      x(j) = -nearby_stop_[k] * impulses(i);
      step_ += x(j) * responses_.col(i);
      if (impulses(i) > 0.0 && !was_hit[i] && !previous_stop_side[k]) arrivals_.push_back({k, false, nearby_stop_[k]});
      was_hit[i] |= impulses(i) > 0.0;
    }
    step += step_;
    return !system_.integrand ||
           system_.integrand->at_impact(step_, struck_joints, responses_(Eigen::all, stops), x, restitution);
  };
  Vector gap_rates;
  if (!resolve_impact(problem, apply, gap_rates)) return false;
  system_.add_velocity(y, step);
  if (!sync_state(t, y)) return false;
  rest_speed_ =
      10 * rate_rounding * std::max(fastest_rate, step.cwiseQuotient(reach).lpNorm<Eigen::Infinity>()) * reach;
  for (Eigen::Index i = 0; i < m; ++i) {
    const int k = candidates[i];
    const double return_rate = return_acceleration(k), gap_rate = gap_rates(i);
    if (gap_rate == 0.0) {
      joints_.stop_side[k] = nearby_stop_[k], rest_speed_(k) = infinity;
      if (!previous_stop_side[k]) record(t, k, JointTransition::touches, nearby_stop_[k]);
    } else if (was_hit[i] || previous_stop_side[k]) {
      record(t, k, previous_stop_side[k] ? JointTransition::leaves : JointTransition::bounces, nearby_stop_[k]);
      if (return_rate > 0.0) first_bounce_duration = std::min(first_bounce_duration, 2 * gap_rate / return_rate);
    }
    nearby_stop_[k] = joints_.stop_side[k];
  }
  return true;
}

// Gauss' principle: among the accelerations that loops and stops allow, choose those that are closest, in the metric of
// D', to the accelerations without holding forces, where friction penalizes |acceleration|. The dual problem is a
// quadratic program in the holding forces between their bounds.
bool JointModeTransitions::resolve_holding(double t, Out y, const Indices& previously_locked) {
  Indices candidates, locked;
  const Indices previous_direction = joints_.sliding_direction, previous_stop = joints_.stop_side;
  joints_.locked.clear();
  for (int k = 0; k < core_.n; ++k) {
    const bool has_friction = joints_.has_friction_at(k);
    const bool is_touching = nearby_stop_[k] && is_at_rest(k);
    joints_.stop_side[k] = is_touching ? nearby_stop_[k] : 0;
    joints_.sliding_direction[k] = has_friction && !is_at_rest(k) ? (v_(k) > 0.0 ? 1 : -1) : 0;
    if (is_touching || (has_friction && is_at_rest(k))) candidates.push_back(k);
  }
  if (!candidates.empty()) {
    if (!system_.acceleration(t, a_)) return false;
    // A joint that the loops block, such as a slide at its dead centre, either reverses or stays at rest.
    const double fastest_rate = a_.cwiseQuotient(joints_.table.reach).lpNorm<Eigen::Infinity>();
    for (int k : candidates)
      if (joints_.has_friction_at(k) &&
          std::abs(a_(k)) > acceleration_tolerance * fastest_rate * joints_.table.reach(k))
        joints_.sliding_direction[k] = a_(k) > 0.0 ? 1 : -1;
    const Indices all = candidates, touching = joints_.stop_side;
    if (!keep_movable(candidates)) return false;
    for (int k : all) joints_.stop_side[k] = 0;
    for (int k : candidates) joints_.sliding_direction[k] = 0, joints_.stop_side[k] = touching[k];
  }
  const auto m = static_cast<Eigen::Index>(candidates.size());
  if (m) {
    scale_responses(candidates);
    b_.resize(m), low_.resize(m), high_.resize(m);
    for (Eigen::Index i = 0; i < m; ++i) b_(i) = scale_(i) * a_(candidates[i]);
    double max_friction_acceleration = 0.0;  // that friction alone would cause
    for (Eigen::Index i = 0; i < m; ++i)
      max_friction_acceleration =
          std::max(max_friction_acceleration, joints_.table.friction(candidates[i]) / scale_(i));
    // Accelerations within rounding keep a joint locked.
    core_.acceleration_rounding(candidates, responses_, system_.applied_force(v_), a_, rounding_);
    rounding_ = rounding_.cwiseProduct(scale_);
    const double scale = std::max({b_.lpNorm<Eigen::Infinity>(), friction_scale_factor * max_friction_acceleration,
                                   rounding_.maxCoeff(), 1e-300});
    const double reduction = holding_was_exceeded_ ? holding_reduction : 0.0;
    b_ /= scale;
    // The accelerations of dependent rows contradict each other within rounding. Remove that part of b_, but no larger
    // contradiction.
    const Eigen::SelfAdjointEigenSolver<Matrix> eigen(A_);
    const auto& values = eigen.eigenvalues();
    const auto project = [&](double tolerance) {
      for (Eigen::Index k = 0; k < m && values(k) <= dependent_row_tolerance * values(m - 1); ++k) {
        const double component = eigen.eigenvectors().col(k).dot(b_);
        if (std::abs(component) <= tolerance) b_ -= component * eigen.eigenvectors().col(k);
      }
    };
    project(std::max({acceleration_tolerance, friction_rounding_factor * max_friction_acceleration / scale,
                      rounding_.norm() / scale}));
    for (Eigen::Index i = 0; i < m; ++i) {
      const double lower = joints_.lower_force(candidates[i]) / (scale_(i) * scale),
                   upper = joints_.upper_force(candidates[i]) / (scale_(i) * scale);
      const double reduction_here = std::min(reduction, 0.5 * (upper - lower));
      low_(i) = lower + reduction_here, high_(i) = upper - reduction_here;
    }
    // If stops push against each other, there is no solution. Use the closest accelerations that are consistent.
    if (!minimize_in_box(A_, b_, low_, high_, x_)) {
      project(infinity);
      if (!minimize_in_box(A_, b_, low_, high_, x_)) return false;
    }
    const Vector acceleration = A_ * x_ + b_;
    for (Eigen::Index i = 0; i < m; ++i) {
      const int k = candidates[i];
      // Complementarity: the force is at its bound, or the acceleration is zero.
      const double bound_distance = acceleration(i) > 0.0 ? x_(i) - low_(i) : high_(i) - x_(i);
      if (!(std::abs(acceleration(i)) > std::max({acceleration_tolerance, bound_distance, rounding_(i) / scale}))) {
        locked.push_back(k);
        continue;
      }
      if (!was_reflected(k)) {
        arrivals_.push_back({k, true});
        if (nearby_stop_[k]) arrivals_.push_back({k, false, nearby_stop_[k]});
      }
      joints_.stop_side[k] = 0;
      if (joints_.has_friction_at(k)) joints_.sliding_direction[k] = acceleration(i) > 0.0 ? 1 : -1;
    }
  }
  joints_.lock(locked, coordinates);
  joints_.immobile.clear();
  for (int k = 0; k < core_.n; ++k) {
    const bool is_locked = contains(locked, k);
    if (joints_.stop_side[k] && !previous_stop[k]) arrivals_.push_back({k, false, joints_.stop_side[k]});
    if (joints_.stop_side[k] && !previous_stop[k]) record(t, k, JointTransition::touches, joints_.stop_side[k]);
    if (!joints_.stop_side[k] && previous_stop[k]) record(t, k, JointTransition::leaves, previous_stop[k]);
    if (joints_.sliding_direction[k] && joints_.sliding_direction[k] != previous_direction[k])
      record(t, k, JointTransition::slides, joints_.sliding_direction[k]);
    if (is_locked && !contains(previously_locked, k) && !joints_.stop_side[k]) record(t, k, JointTransition::sticks, 0);
    if (joints_.has_friction_at(k) && !joints_.sliding_direction[k] && !is_locked) joints_.immobile.push_back(k);
  }
  bool changed;
  if (!locked.empty() && !system_.correct_locked_joints(y, 0.0, changed)) return false;
  if (!sync_state(t, y)) return false;
  system_.resume(t, y);
  return true;
}

}  // namespace ckc
