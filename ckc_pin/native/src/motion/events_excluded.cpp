// Excludes events from the search that cannot occur in a step.
#include <algorithm>
#include <cmath>

#include "motion/events.hpp"

namespace ckc {

// Required distance from zero: a multiple of the difference between two interpolations of different order, and a
// fraction of the function's range in the step.
constexpr double interpolation_error_factor = 3.0, min_range_ratio = 0.1;

// Whether a coordinate or rate stays away from its value throughout the step. Uses Hermite interpolation of the ends
// with and without accelerations; their difference estimates the error.
bool Events::is_excluded(const Event& event) const {
  if (!start_is_known_ || !start_.has_acceleration || !end_.has_acceleration || event.quantity > Event::q_dot)
    return false;
  const int k = event.coordinate;
  const double h = step_.t_new - step_.t;
  const double v0 = h * start_.v(k), v1 = h * end_.v(k), a0 = h * h * start_.a(k), a1 = h * h * end_.a(k);
  const double displacement = end_.q(k) - start_.q(k), value = displacement - v0 - a0 / 2, slope = v1 - v0 - a0,
               bend = a1 - a0;
  const double c3 = 10 * value - 4 * slope + bend / 2, c4 = -15 * value + 7 * slope - bend,
               c5 = 6 * value - 3 * slope + bend / 2;
  double low = std::numeric_limits<double>::infinity(), high = -low, difference = 0.0;
  for (double s = 0.0; s <= 1.0; s += 0.125) {
    double fine_value, coarse;
    if (event.quantity == Event::q) {
      fine_value = start_.q(k) + s * (v0 + s * (a0 / 2 + s * (c3 + s * (c4 + s * c5))));
      coarse = start_.q(k) + s * (v0 + s * (3 * displacement - 2 * v0 - v1 + s * (v0 + v1 - 2 * displacement)));
    } else {
      fine_value = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h;
      coarse = (v0 + s * (a0 + s * (3 * (v1 - v0) - 2 * a0 - a1 + s * (a0 + a1 - 2 * (v1 - v0))))) / h;
    }
    low = std::min(low, fine_value), high = std::max(high, fine_value);
    difference = std::max(difference, std::abs(fine_value - coarse));
  }
  const double margin = interpolation_error_factor * difference + min_range_ratio * (high - low) + event.zero_threshold;
  return event.value < low - margin || event.value > high + margin;
}

// Whether the holding margin at the ends and the middle of the step is clearly positive. The middle is from a cubic
// Hermite polynomial; its distance from the chord estimates the variation.
bool Events::joints_clearly_held(int k) {
  if (events_[k].quantity != Event::holding_margin || last_values_time_ != step_.t || !start_is_known_ ||
      std::isnan(end_holding_margin_))
    return false;
  const double h = step_.t_new - step_.t, start = last_values_[k];
  core_accuracy_ = not_set;
  y_ = 0.5 * (step_.y + step_.y_new) + (h / 8) * (step_.f - step_.f_new);
  double middle;
  if (!event_value(k, step_.t + 0.5 * h, middle)) return failed = -1, false;
  const double low = std::min({start, middle, end_holding_margin_}),
               high = std::max({start, middle, end_holding_margin_});
  const double difference = std::abs(middle - 0.5 * (start + end_holding_margin_));
  return low > interpolation_error_factor * difference + min_range_ratio * (high - low) + events_[k].zero_threshold;
}

// Whether the holding margin at every second sample point is clearly positive. Compares the samples with the parabola
// through the ends and the middle.
bool Events::joints_hold_throughout(int k) const {
  if (events_[k].quantity != Event::holding_margin) return false;
  const auto value = [&](int part) { return values_(part * sample_degree / 4, k); };
  const double slope = (value(4) - value(0)) * M_SQRT1_2 / 2, bend = ((value(4) + value(0)) / 2 - value(2)) / 2;
  const double difference =
      std::max(std::abs(value(2) - slope + bend - value(1)), std::abs(value(2) + slope + bend - value(3)));
  double low = value(0), high = low;
  for (int part = 1; part <= 4; ++part) low = std::min(low, value(part)), high = std::max(high, value(part));
  return low > interpolation_error_factor * difference + min_range_ratio * (high - low) + events_[k].zero_threshold;
}

}  // namespace ckc
