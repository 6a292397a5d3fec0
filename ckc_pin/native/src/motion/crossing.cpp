#include "motion/crossing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace ckc {

// Of the time to a crossing: one that is as much behind the end of the run is left alone; how well it has to be in the
// middle of the step; the last step of Newton's method on it ahead of time, whose next one would be its square.
constexpr double beyond = 0.3, centred = 0.04, foreseen = 0.01;
constexpr double ahead = 0.1;  // of s: what is left of it at a crossing, the motion extrapolated
constexpr int most_attempts = 6, newton = 10, places = 9;
constexpr int bits_ahead = 8, bits_within = 24;  // how closely the least value is looked for
constexpr double lost = RankMonitor::lost, none = std::numeric_limits<double>::quiet_NaN();

Crossing::Crossing(System& system, Method*& method, Step& step, RankMonitor& monitor,
                   std::unique_ptr<Collocation> collocation_, double closed)
    : collocation(std::move(collocation_)),
      system_(system),
      method_(method),
      step_(step),
      monitor_(monitor),
      closed_(closed) {
  y_.setZero(system.size);
  begin();
}

void Crossing::begin() { inside_ = none, reach_ = std::numeric_limits<double>::infinity(), attempts_ = 0; }

bool Crossing::passes() const { return collocation && attempts_ < most_attempts; }

double Crossing::left(const Rank& end, double length, double t_bound) {
  const double t = step_.t, inside = std::exchange(inside_, none);
  if (std::isfinite(inside)) return inside - t;
  if (!passes() || !RankMonitor::ahead(end, length)) return none;
  Core& core = system_.core;
  const int nq = core.tree.nq;
  const auto extrapolated = [&](double at) {  // as it accelerates now
    const double h = at - t;
    y_ = step_.y + h * step_.f;
    if (nq == core.n) y_.head(nq) += (0.5 * h * h) * step_.f.tail(core.n);
  };
  const auto place = [&](double at) { return extrapolated(at), system_.place(y_); };
  const double tangent = end.value / -end.rate, from = t + 0.3 * tangent, to = t + 1.3 * tangent;
  RankMonitor::Least least{zero(extrapolated, t + tangent, foreseen * tangent), 0.0};
  if (!(least.t > from && least.t < to)) least = monitor_.least(core, place, from, to, bits_ahead);
  return least.value >= ahead * end.value || least.t - t_bound > beyond * (least.t - t) ? none : least.t - t;
}

Crossing::Verdict Crossing::judge(const Rank& end, const Rank& after) {
  const double h = step_.t_new - step_.t, part = RankMonitor::part(end, after, h);
  if (std::isnan(part)) {
    const auto within = [&](double at) {
      return method_->between(at, y_) && (system_.place(y_) || system_.exact(at, y_));
    };
    const RankMonitor::Least least = monitor_.least(system_.core, within, step_.t, step_.t_new, bits_within);
    if (least.value < lost) {
      if (!passes()) return {0.0, true, least.t, least.value};
      inside_ = least.t;
      return {0.5 * (least.t - step_.t) / h};
    }
    const double resolved = RankMonitor::part(end, after, h, least.value);
    if (resolved < 1.0 || RankMonitor::kept(after)) return {resolved};
  }
  if (!RankMonitor::kept(after) && !(part < 1.0)) {
    if (!passes()) return {0.0, true, step_.t_new, after.value};
    inside_ = step_.t_new;
    return {0.5};
  }
  return {std::isnan(part) ? 1.0 : part};
}

double Crossing::over(double left, double length) {
  double met = none;
  if (left <= std::max(reach_, length)) {  // a step as long as the last one does not pass it either
    const double crossing = step_.t + left;
    ++attempts_;
    if (left < 0.5 * length)  // so near J is ill-conditioned: rather from where the last step began
      met = from(step_.t_old, step_.y_old, crossing);
    if (!std::isfinite(met)) met = from(step_.t, step_.y, crossing);
  }
  if (std::isfinite(met)) {
    attempts_ = 0;
  } else {  // let the next step end where one may succeed, unless it is to be shorter anyway
    const double length = std::max(left - 0.9 * reach_, 0.1 * left);
    if (step_.h > length) method_->forget(), step_.h = length;
  }
  return met;
}

// Step from (t, y) with the crossing in the middle; when exactly it was met, NaN if it was not.
double Crossing::from(double t, In y, double crossing) {
  for (int k = 0; k < 2; ++k) {
    const double left = crossing - t;
    collocation->make(t, y, 2 * left, k > 0);
    reach_ = left * std::clamp(collocation->scale(), 0.25, 2.0);
    if (!collocation->good()) break;
    const double when = zero([&](double at) { collocation->at(at, y_); }, crossing, 0.0), middle = (when - t) / left;
    if (!(middle > 0.5 && middle < 1.5) || !closed()) break;
    if (std::abs(when - crossing) < centred * left) return when;
    crossing = when;
  }
  return none;
}

// By Newton's method: with its sign the value is smooth there, on both sides it over its rate is what is left.
template <class Motion>
double Crossing::zero(const Motion& motion, double t, double accuracy) {
  double value = std::numeric_limits<double>::infinity();
  for (int k = 0; k < newton; ++k) {
    motion(t);
    if (!y_.allFinite() || !system_.at_last(t, y_)) return none;
    const double before = value;
    const Rank found = monitor_.at(system_);
    value = found.value;
    if (value <= 1e-3 * lost) return t;
    if (!(value < 0.5 * before) || found.rate == 0.0) break;
    const double step = value / found.rate;
    t -= step;
    if (std::abs(step) <= accuracy) return t;
  }
  return value <= lost ? t : none;
}

// Whether the branches meet: off the closure the step would have jumped a narrow gap between them.
bool Crossing::closed() {
  for (int k = 0; k < places; ++k) {
    collocation->at(collocation->t_old + (collocation->t - collocation->t_old) * k / (places - 1), y_);
    if (!system_.place(y_) || system_.core.rows.phi.lpNorm<Eigen::Infinity>() > closed_) return false;
  }
  return true;
}

}  // namespace ckc
