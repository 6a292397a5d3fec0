#include "loop.hpp"

#include <cmath>
#include <limits>

namespace ckc {

// What a step, its outputs and what it refuses cost at most, and what all that it takes to leap does.
constexpr long step_rhs = 100, leap_rhs = 6000;

Why Loop::run(const Stretch& stretch, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows, Eigen::Index& filled) {
  using Clock = std::chrono::steady_clock;
  const auto pause = Clock::now() + std::chrono::duration_cast<Clock::duration>(
                                        std::chrono::duration<double>(stretch.seconds));
  const long started = method_.rhs;
  ahead = std::numeric_limits<double>::quiet_NaN();
  if (!begun) {
    if (!system_.exact(method_.t, method_.y)) return Why::python;
    end = watch_.rank(system_);
    begun = true;
  }
  while (method_.t < stretch.t_bound) {
    if (Clock::now() >= pause || (filled == rows.cols() && due < times.size())) return Why::pause;
    if (method_.rhs - started + step_rhs > stretch.most_rhs) return Why::python;
    const Counts counts = system_.counts;
    const long rhs = method_.rhs, rejected = method_.rejected;
    const Eigen::Index due_before = due, filled_before = filled;
    const auto python = [&] {  // nothing has happened
      system_.counts = counts, method_.rhs = rhs, method_.rejected = rejected;
      due = due_before, filled = filled_before;
      return Why::python;
    };
    const double left = crossing_.left(end, length, stretch.t_bound);
    double met = std::numeric_limits<double>::quiet_NaN();
    if (std::isfinite(left)) {
      const bool affordable = method_.rhs - started + leap_rhs <= stretch.most_rhs;
      if (crossing_.leap && affordable) met = crossing_.over(left, length);
      if (!crossing_.leap || !affordable || (std::isfinite(met) && !stretch.fine)) {
        ahead = method_.t + left;
        return python();
      }
    }
    Watch::Rank after;
    const bool leapt = std::isfinite(met);
    const Made made = leapt ? leap(stretch, left, after) : step(stretch, after);
    if (made == Made::shorter) continue;
    if (made == Made::none) return python();
    if (!outputs(stretch, leapt, times, due, rows, filled))
      return filled == rows.cols() ? (python(), Why::pause) : python();
    if (!method_.settle(system_, stretch.t_bound)) return python();
    crossing_.kept(after);
    if (leapt)
      crossings.push_back(met);
    else
      length = method_.t - method_.t_old;
    end = after, ++steps;
  }
  return Why::finished;
}

Loop::Made Loop::step(const Stretch& stretch, Watch::Rank& after) {
  if (!method_.step(system_, stretch.t_bound)) return Made::none;
  const double h = method_.t_new - method_.t;
  if (h < stretch.min_step && method_.t_new < stretch.t_bound) return Made::none;
  if (!system_.at_last(method_.t_new, method_.y_new)) return Made::none;
  after = watch_.rank(system_);
  const double kept = crossing_.part(end, after, h);
  if (kept == 0.0) return Made::none;
  if (kept < 1.0) return method_.again(kept * h) ? Made::shorter : Made::none;
  return !system_.needs_chart || watch_.chart(system_.core) ? Made::all : Made::none;
}

Loop::Made Loop::leap(const Stretch& stretch, double left, Watch::Rank& after) {
  const double to = std::min(crossing_.leap->t, stretch.t_bound);
  crossing_.leap->at(to, y_out_);
  if (!method_.adopt(system_, to, y_out_, length > 0.0 ? length : left)) return Made::none;
  if (!system_.exact(to, y_out_)) return Made::none;
  after = watch_.rank(system_);
  return watch_.plain(after) ? Made::all : Made::none;
}

bool Loop::outputs(const Stretch& stretch, bool leapt, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows,
                   Eigen::Index& filled) {
  const double last = std::min(method_.t_new, stretch.last_output);
  for (; due < times.size() && times(due) <= last; ++due, ++filled) {
    if (filled == rows.cols()) return false;
    const double t = times(due);
    if (t == method_.t_new)
      y_out_ = method_.y_new;
    else if (leapt)
      crossing_.leap->at(t, y_out_);
    else if (!method_.between(system_, t, y_out_))
      return false;
    if (!record_.row(system_, t, y_out_, rows.col(filled))) return false;
  }
  return true;
}

}  // namespace ckc
