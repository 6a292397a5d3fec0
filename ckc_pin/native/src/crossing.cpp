#include "crossing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace ckc {

// As in `simulation.rank_guard`; `bits`: how closely the least value is looked for, ahead and within a step; `foreseen`:
// of the time to a crossing, the last step of Newton's method on it, whose next one would be its square.
constexpr double lost = 1e-5, beyond = 0.3, ahead = 0.1, centred = 0.04, foreseen = 0.01;
constexpr int most_attempts = 6, newton = 10, bits_ahead = 8, bits_within = 24, places = 9;
constexpr double none = std::numeric_limits<double>::quiet_NaN();

Crossing::Crossing(System& system, Method& method, Watch& watch, std::unique_ptr<Leap> leap_, double closed)
    : leap(std::move(leap_)),
      system_(system),
      method_(method),
      watch_(watch),
      closed_(closed),
      inside_(none),
      reach_(std::numeric_limits<double>::infinity()) {
  y_.setZero(system.size);
}

void Crossing::begin() { inside_ = none; }

double Crossing::left(const Watch::Rank& end, double length, double t_bound) {
  const double t = method_.t, inside = inside_;
  inside_ = none;
  if (std::isfinite(inside)) return inside - t;
  if (!system_.crosses || attempts_ >= most_attempts || !watch_.ahead(end, length)) return none;
  const Core& core = system_.core;
  const int nq = core.tree.nq;
  const auto extrapolated = [&](double at) {  // as it accelerates now
    const double h = at - t;
    y_ = method_.y + h * method_.f;
    if (nq == core.n) y_.head(nq) += (0.5 * h * h) * method_.f.tail(core.n);
  };
  const auto place = [&](double at) { return extrapolated(at), system_.place(y_); };
  const double tangent = end.value / -end.rate, from = t + 0.3 * tangent, to = t + 1.3 * tangent;
  Watch::Least least{zero(extrapolated, t + tangent, foreseen * tangent), 0.0};
  if (!(least.t > from && least.t < to)) least = watch_.least(core, place, from, to, bits_ahead);
  return least.value >= ahead * end.value || least.t - t_bound > beyond * (least.t - t) ? none : least.t - t;
}

double Crossing::part(const Watch::Rank& end, const Watch::Rank& after, double h) {
  const double kept = watch_.part(end, after, h);
  if (kept > 0.0 || !system_.crosses) return kept;
  const auto within = [&](double at) { return method_.between(system_, at, y_) && system_.place(y_); };
  const Watch::Least least = watch_.least(system_.core, within, method_.t, method_.t_new, bits_within);
  if (!(least.value < lost)) return watch_.part(end, after, h, least.value);
  if (!leap || attempts_ >= most_attempts) return 0.0;
  inside_ = least.t;
  return 0.5 * (least.t - method_.t) / h;
}

double Crossing::over(double left, double length) {
  double met = none;
  if (left <= std::max(reach_, length)) {  // a step as long as the last one does not pass it either
    const double crossing = method_.t + left;
    ++attempts_;
    if (left < 0.5 * length)  // so near J is ill-conditioned: rather from where the last step began
      met = from(method_.t_old, method_.y_old, crossing);
    if (!std::isfinite(met)) met = from(method_.t, method_.y, crossing);
    method_.rhs += std::exchange(leap->rhs, 0);
  }
  if (std::isfinite(met))
    attempts_ = 0;
  else
    approach(left);
  return met;
}

// Leap from (t, y) with the crossing in the middle; when exactly it was met, NaN if it was not.
double Crossing::from(double t, In y, double crossing) {
  for (int k = 0; k < 2; ++k) {
    const double left = crossing - t;
    leap->make(t, y, 2 * left, k > 0);
    reach_ = left * std::clamp(leap->scale(), 0.25, 2.0);
    if (!leap->good()) break;
    const double when = zero([&](double at) { leap->at(at, y_); }, crossing, 0.0), middle = (when - t) / left;
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
    const Watch::Rank found = watch_.rank(system_);
    value = found.value;
    if (value <= 1e-3 * lost) return t;
    if (!(value < 0.5 * before) || found.rate == 0.0) break;
    const double step = value / found.rate;
    t -= step;
    if (std::abs(step) <= accuracy) return t;
  }
  return value <= lost ? t : none;
}

// Whether the branches meet: off the closure the leap would have jumped a narrow gap between them.
bool Crossing::closed() {
  for (int k = 0; k < places; ++k) {
    leap->at(leap->t_old + (leap->t - leap->t_old) * k / (places - 1), y_);
    if (!system_.place(y_) || system_.core.rows.phi.lpNorm<Eigen::Infinity>() > closed_) return false;
  }
  return true;
}

// Let the next step end where a leap may succeed, unless it is to be shorter anyway.
void Crossing::approach(double left) {
  const double length = std::max(left - 0.9 * reach_, 0.1 * left);
  if (method_.h_abs > length) method_.h_abs = length, method_.growing = false;
}

}  // namespace ckc
