// Events at transitions of joint modes: jumps across a value, and functions that reach their value and stay there.
#include <algorithm>
#include <cmath>

#include <Eigen/QR>

#include "motion/events.hpp"

namespace ckc {

constexpr double rest_tolerance = 1e-9;       // rad, m and their rates; smaller values may be rounding
constexpr double max_relative_rate = 1e-4;    // relative to the fastest joint; faster joints are moving
constexpr double mobility_threshold = 1e-10;  // relative to the response that the joint would have without loops

// A function that is zero has no sign, so rounding must not assign one. A function that crossed zero in the step that
// ends here, and is still zero within the tolerances, crosses here.
bool Events::determine_signs_before_transition(double t, In y) {
  const Vector& reach = system_.core.joints.table.reach;
  y_ = y, core_accuracy_ = not_set;
  for (int k = 0; k < static_cast<int>(events_.size()); ++k) {
    const Event& event = events_[k];
    const bool just_crossed = crossed_at_[k] >= step_.t_old;
    if (event.is_joint_event || (signs_[k] ? !just_crossed : resting_[k])) continue;
    double value;
    if (!exact_value(k, t, value)) return false;
    const double size = event.quantity == Event::function ? function_rounding * largest_[k]
                        : event.quantity <= Event::q_dot  ? rest_tolerance * reach(event.coordinate)
                                                          : rest_tolerance;
    if (just_crossed && std::abs(value) <= relative_zero_tolerance * largest_[k])
      crossed_at_[k] = t;
    else if (!signs_[k] && std::abs(value) > size)
      signs_[k] = value > 0 ? 1 : -1;
  }
  return true;
}

bool Events::is_held(const Event& event) const {
  return !event.is_joint_event && event.quantity <= Event::q_dot && system_.core.joints.is_locked(event.coordinate);
}

double Events::held_value(const Event& event) const {
  return event.sign *
         ((event.quantity == Event::q ? system_.core.joints.locked_at(event.coordinate) : 0.0) - event.value);
}

void Events::report_arrival(int k, int sign, double& stop_time) {
  const Event& event = events_[k];
  const int before = signs_[k], direction = -before;
  signs_[k] = sign, resting_[k] = !sign;
  if (!before || sign == before) return;
  if (!sign && has_just_crossed(k)) return;  // the crossing was found in the previous step
  crossed_at_[k] = step_.t;
  if (event.direction && event.direction != direction) return;
  new_occurrences_.push_back({step_.t, k, direction});
  if (event.stop || event.switches_joints) stop_time = std::min(stop_time, step_.t);
}

bool Events::has_just_crossed(int k) const { return std::abs(step_.t - crossed_at_[k]) <= change_time_tolerance_; }

bool Events::stays_on_value(int k) {
  const Event& event = events_[k];
  const RootSearch& search = searches_[k];
  if (joints_changed_ && search.always_on_zero) return true;
  if (event.quantity > Event::q_dot) return false;
  const bool unchanged = search.sign_changes.empty() && search.sign == signs_[k];
  if (unchanged && !(signs_[k] && (joints_changed_ || search.on_zero))) return false;
  return is_still(k) && !can_move(event.coordinate, step_.t, step_.y) &&
         !can_move(event.coordinate, step_.t_new, step_.y_new);
}

// Whether the sampled coordinate or rate is constant on the event's value within rounding and tolerance.
bool Events::is_still(int k) const {
  const Event& event = events_[k];
  const Vector& reach = system_.core.joints.table.reach;
  const double size = reach(event.coordinate);
  double fastest = 0.0;
  for (const End* end : {&start_, &end_})
    fastest = std::max(fastest, end->v.cwiseQuotient(reach).lpNorm<Eigen::Infinity>());
  const double low = values_.col(k).minCoeff(), high = values_.col(k).maxCoeff();
  const double largest = std::max(std::abs(low), std::abs(high));
  if (event.quantity == Event::q_dot)
    return std::abs(event.value) <= rest_tolerance * size &&
           largest <= (max_relative_rate * fastest + rest_tolerance) * size;
  const double h = step_.t_new - step_.t;
  return (low * high <= 0.0 || largest <= rest_tolerance * size) &&
         high - low <= (max_relative_rate * fastest * h + rest_tolerance) * size;
}

// Response of the coordinate to a force on it, with the joints at rest held in place.
bool Events::can_move(int coordinate, double t, In y) {
  Core& core = system_.core;
  const Indices& locked = core.joints.locked;
  Indices coordinates = locked;
  coordinates.push_back(coordinate);
  core_accuracy_ = not_set;
  if (!system_.sync_core(t, y) || !core.unit_force_responses(coordinates, responses_)) return true;
  const auto m = static_cast<Eigen::Index>(coordinates.size()), last = m - 1;
  Vector scale(m);
  for (Eigen::Index i = 0; i < m; ++i) scale(i) = std::sqrt(core.joint_inertia(coordinates[i]));
  Matrix A(m, m);  // responses, relative to those without loops
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j) A(i, j) = scale(i) * scale(j) * responses_(coordinates[i], j);
  double response = A(last, last);
  if (last) {
    Eigen::CompleteOrthogonalDecomposition<Matrix> held(last, last);
    held.setThreshold(mobility_threshold);
    held.compute(A.topLeftCorner(last, last));
    response -= A.row(last).head(last).dot(held.solve(A.col(last).head(last)));
  }
  return response > mobility_threshold;
}

}  // namespace ckc
