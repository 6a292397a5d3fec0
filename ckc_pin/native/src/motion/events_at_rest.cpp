// Events where joints change: a jump over a value, and functions that come to their value and stay there.
#include <algorithm>
#include <cmath>

#include <Eigen/QR>

#include "motion/events.hpp"

namespace ckc {

constexpr double rest_tolerance = 1e-9;       // rad, m and their rates: what is no larger may be rounding
constexpr double max_relative_rate = 1e-4;    // of the fastest joint: a joint that is faster can move, and is not examined
constexpr double mobility_threshold = 1e-10;  // of the motion that the same force would give the joint alone

// A function on its value has no sign, and rounding gives it none. A function that crossed its value in the step that ends
// here, and is still as near to it as the tolerances allow, counts as crossing it here.
bool Events::learn_signs_before_change(double t, In y) {
  const Vector& reach = system_.core.joints.table.reach;
  y_ = y, closed_ = only_y;
  for (int k = 0; k < static_cast<int>(events_.size()); ++k) {
    const Event& event = events_[k];
    const bool crossed = crossed_at_[k] >= step_.t_old;
    if (event.own || (signs_[k] ? !crossed : resting_[k])) continue;
    double gap;
    if (!exact_value(k, t, gap)) return false;
    const double size = event.of == Event::function ? function_rounding * largest_[k]
                        : event.of <= Event::q_dot  ? rest_tolerance * reach(event.coordinate)
                                                    : rest_tolerance;
    if (crossed && std::abs(gap) <= zero_tolerance * largest_[k])
      crossed_at_[k] = t;
    else if (!signs_[k] && std::abs(gap) > size)
      signs_[k] = gap > 0 ? 1 : -1;
  }
  return true;
}

bool Events::is_held(const Event& event) const {
  return !event.own && event.of <= Event::q_dot && system_.core.joints.is_locked(event.coordinate);
}

double Events::held_value(const Event& event) const {
  return event.sign * ((event.of == Event::q ? system_.core.joints.place(event.coordinate) : 0.0) - event.value);
}

void Events::report_arrival(int k, int sign, double& halt) {
  const Event& event = events_[k];
  const int before = signs_[k], direction = -before;
  signs_[k] = sign, resting_[k] = !sign;
  if (!before || sign == before) return;
  if (!sign && has_just_crossed(k)) return;  // the crossing was found in the step before
  crossed_at_[k] = step_.t;
  if (event.direction && event.direction != direction) return;
  found_.push_back({step_.t, k, direction});
  if (event.stop) halt = std::min(halt, step_.t);
}

bool Events::has_just_crossed(int k) const { return std::abs(step_.t - crossed_at_[k]) <= change_time_tolerance_; }

bool Events::stays_on_value(int k) {
  const Event& event = events_[k];
  const Walk& walked = walks_[k];
  if (joints_changed_ && walked.always_on_zero) return true;
  if (event.of > Event::q_dot) return false;
  const bool unchanged = walked.found.empty() && walked.sign == signs_[k];
  if (unchanged && !(signs_[k] && (joints_changed_ || walked.on_zero))) return false;
  return is_still(k) && !can_move(event.coordinate, step_.t, step_.y) &&
         !can_move(event.coordinate, step_.t_new, step_.y_new);
}

// Whether the values of a coordinate or a rate are those of a joint at rest on the event's value, as far as rounding and
// the tolerance allow.
bool Events::is_still(int k) const {
  const Event& event = events_[k];
  const Vector& reach = system_.core.joints.table.reach;
  const double size = reach(event.coordinate);
  double fastest = 0.0;
  for (const End* end : {&start_, &end_})
    fastest = std::max(fastest, end->v.cwiseQuotient(reach).lpNorm<Eigen::Infinity>());
  const double low = values_.col(k).minCoeff(), high = values_.col(k).maxCoeff();
  const double largest = std::max(std::abs(low), std::abs(high));
  if (event.of == Event::q_dot)
    return std::abs(event.value) <= rest_tolerance * size &&
           largest <= (max_relative_rate * fastest + rest_tolerance) * size;
  const double h = step_.t_new - step_.t;
  return (low * high <= 0.0 || largest <= rest_tolerance * size) &&
         high - low <= (max_relative_rate * fastest * h + rest_tolerance) * size;
}

// The joint's response to a force on it, less what the forces of the joints at rest take away.
bool Events::can_move(int coordinate, double t, In y) {
  Core& core = system_.core;
  const Indices& locked = core.joints.locked;
  Indices at = locked;
  at.push_back(coordinate);
  closed_ = only_y;
  if (!system_.exact(t, y) || !core.responses(at, responses_)) return true;
  const auto m = static_cast<Eigen::Index>(at.size()), last = m - 1;
  Vector scale(m);
  for (Eigen::Index i = 0; i < m; ++i) scale(i) = std::sqrt(core.inertia_alone(at[i]));
  Matrix A(m, m);  // responses to unit forces, relative to those of joints without loops
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j) A(i, j) = scale(i) * scale(j) * responses_(at[i], j);
  double moves = A(last, last);
  if (last) {
    Eigen::CompleteOrthogonalDecomposition<Matrix> held(last, last);
    held.setThreshold(mobility_threshold);
    held.compute(A.topLeftCorner(last, last));
    moves -= A.row(last).head(last).dot(held.solve(A.col(last).head(last)));
  }
  return moves > mobility_threshold;
}

}  // namespace ckc
