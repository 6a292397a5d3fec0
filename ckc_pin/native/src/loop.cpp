#include "loop.hpp"

namespace ckc {

constexpr long step_rhs = 100;  // a step, its outputs and what it refuses cost fewer evaluations than that

Why Loop::run(const Stretch& stretch, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows, Eigen::Index& filled) {
  using Clock = std::chrono::steady_clock;
  const auto pause = Clock::now() + std::chrono::duration_cast<Clock::duration>(
                                        std::chrono::duration<double>(stretch.seconds));
  const long started = method_.rhs;
  if (!begun) {
    if (!system_.exact(method_.t, method_.y)) return Why::python;
    end = watch_.rank(system_);
    begun = true;
  }
  while (method_.t < stretch.t_bound) {
    if (Clock::now() >= pause || filled == rows.cols()) return Why::pause;
    if (method_.rhs - started + step_rhs > stretch.most_rhs) return Why::python;
    const Counts counts = system_.counts;
    const long rhs = method_.rhs, rejected = method_.rejected;
    const Eigen::Index due_before = due, filled_before = filled;
    const auto python = [&] {  // nothing has happened
      system_.counts = counts, method_.rhs = rhs, method_.rejected = rejected;
      due = due_before, filled = filled_before;
      return Why::python;
    };
    if (system_.crosses && watch_.ahead(end, length)) return Why::python;
    if (!method_.step(system_, stretch.t_bound)) return python();
    const double h = method_.t_new - method_.t;
    if (h < stretch.min_step && method_.t_new < stretch.t_bound) return python();
    if (!system_.at_last(method_.t_new, method_.y_new)) return python();
    const Watch::Rank after = watch_.rank(system_);
    if (!watch_.plain(end, after, h) || (system_.needs_chart && !watch_.chart(system_.core))) return python();
    if (!outputs(stretch, times, due, rows, filled)) return filled == rows.cols() ? (python(), Why::pause) : python();
    if (!method_.settle(system_, stretch.t_bound)) return python();
    end = after, length = h, ++steps;
  }
  return Why::finished;
}

bool Loop::outputs(const Stretch& stretch, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows,
                   Eigen::Index& filled) {
  const double last = std::min(method_.t_new, stretch.last_output);
  for (; due < times.size() && times(due) <= last; ++due, ++filled) {
    if (filled == rows.cols()) return false;
    const double t = times(due);
    if (t == method_.t_new)
      y_out_ = method_.y_new;
    else if (!method_.between(system_, t, y_out_))
      return false;
    if (!record_.row(system_, t, y_out_, rows.col(filled))) return false;
  }
  return true;
}

}  // namespace ckc
