// Which events cannot happen in a step, by what is known of it already.
#include <algorithm>
#include <cmath>

#include "motion/events.hpp"

namespace ckc {

constexpr double uncertain = 3.0;     // times how far two interpolations of different order are apart,
constexpr double of_range = 0.1;      // and of a function's range in the step: so far from zero it has to be to stay away

// Whether a coordinate, or its rate, stays away from its value all through the step: by Hermite interpolation of its
// ends, with the accelerations and without them, which tells how far off that may be.
bool Events::ruled_out(const Event& event) const {
  if (!known_ || !start_.accelerated || !end_.accelerated || event.of > Event::q_dot) return false;
  const int k = event.coordinate;
  const double h = step_.t_new - step_.t;
  const double v0 = h * start_.v(k), v1 = h * end_.v(k), a0 = h * h * start_.a(k), a1 = h * h * end_.a(k);
  const double way = end_.q(k) - start_.q(k), gap = way - v0 - a0 / 2, slope = v1 - v0 - a0, bend = a1 - a0;
  const double c3 = 10 * gap - 4 * slope + bend / 2, c4 = -15 * gap + 7 * slope - bend, c5 = 6 * gap - 3 * slope + bend / 2;
  double low = std::numeric_limits<double>::infinity(), high = -low, apart = 0.0;
  for (double s = 0.0; s <= 1.0; s += 0.125) {
    double fine_value, coarse;
    if (event.of == Event::q) {
      fine_value = start_.q(k) + s * (v0 + s * (a0 / 2 + s * (c3 + s * (c4 + s * c5))));
      coarse = start_.q(k) + s * (v0 + s * (3 * way - 2 * v0 - v1 + s * (v0 + v1 - 2 * way)));
    } else {
      fine_value = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h;
      coarse = (v0 + s * (a0 + s * (3 * (v1 - v0) - 2 * a0 - a1 + s * (a0 + a1 - 2 * (v1 - v0))))) / h;
    }
    low = std::min(low, fine_value), high = std::max(high, fine_value);
    apart = std::max(apart, std::abs(fine_value - coarse));
  }
  const double room = uncertain * apart + of_range * (high - low) + event.floor;
  return event.value < low - room || event.value > high + room;
}

// Whether what holds is so far from giving way that the ends of a step and its middle tell, that from a cubic through
// both states and rates: by how far the middle is off the line through the ends.
bool Events::holds_by_far(int k) {
  if (events_[k].of != Event::holding || values_at_ != step_.t || !known_ || std::isnan(end_holds_)) return false;
  const double h = step_.t_new - step_.t, start = last_[k];
  closed_ = only_y;
  y_ = 0.5 * (step_.y + step_.y_new) + (h / 8) * (step_.f - step_.f_new);
  double middle;
  if (!value(k, step_.t + 0.5 * h, middle)) return failed = -1, false;
  const double low = std::min({start, middle, end_holds_}), high = std::max({start, middle, end_holds_});
  const double apart = std::abs(middle - 0.5 * (start + end_holds_));
  return low > uncertain * apart + of_range * (high - low) + events_[k].floor;
}

// Whether what holds, known at every second place, is far from giving way: by the parabola through both ends and the
// middle, and by how far off that is at the places between.
bool Events::holds(int k) const {
  if (events_[k].of != Event::holding) return false;
  const auto value = [&](int part) { return values_(part * walk_degree / 4, k); };
  const double tilt = (value(4) - value(0)) * M_SQRT1_2 / 2, bent = ((value(4) + value(0)) / 2 - value(2)) / 2;
  const double apart = std::max(std::abs(value(2) - tilt + bent - value(1)), std::abs(value(2) + tilt + bent - value(3)));
  double low = value(0), high = low;
  for (int part = 1; part <= 4; ++part) low = std::min(low, value(part)), high = std::max(high, value(part));
  return low > uncertain * apart + of_range * (high - low) + events_[k].floor;
}

}  // namespace ckc
