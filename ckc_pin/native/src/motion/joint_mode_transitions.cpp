#include "motion/joint_mode_transitions.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Eigenvalues>

#include "loops/box_constrained.hpp"
#include "motion/impact.hpp"

namespace ckc {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double rounding = 1e-11;  // of the largest velocity: a joint is at rest; rad, or of the size: it is at a stop
constexpr double gives = 1e-6;      // of the largest force: what holds no more is taken to be so much weaker
constexpr double moves = 1e-12;     // of a joint's response without loops: they let it move
constexpr double negligible = 1e-6, rounded = 1e-8;  // of what friction alone would accelerate
constexpr double seen = 4.0;        // times how far a joint is off its stop
constexpr double exactly = 1e-9;    // of the largest acceleration: none

static bool among(const Indices& list, int k) { return std::find(list.begin(), list.end(), k) != list.end(); }

JointChanges::JointChanges(System& system, double rise, const Tolerance& tolerance)
    : system_(system), core_(system.core), joints_(system.core.joints), rise_(rise), tolerance_(tolerance) {
  const int n = core_.n;
  for (Vector* x : {&coordinates, &v_, &a_, &held_, &rest_, &step_}) x->setZero(n);
  near_.assign(n, 0);
}

void JointChanges::begin() { known_ = false; }

bool JointChanges::take_state(double t, Out y) {
  if (!system_.exact(t, y)) return false;
  system_.put_exact(y);
  core_.tree.to_coordinates(core_.q_tree, coordinates);
  v_ = system_.velocity;
  return true;
}

bool JointChanges::decide(double t, Out y, const std::vector<Event>& met, double within) {
  if (!take_state(t, y)) return false;
  const Vector& reach = joints_.table.reach;
  joints_.account(coordinates);
  // What comes to rest, or to a stop, at the same instant as what was met is as far from it as events are located.
  rest_ = rounding * v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>() * reach;
  if (known_ && within > 0.0) {
    if (!system_.acceleration(t, a_)) return false;
    rest_ += within * a_.cwiseAbs();
  }
  near_ = joints_.touch;
  slips_ = false, flight = infinity;
  for (int k = 0; k < core_.n; ++k)
    for (int side : {-1, 1}) {
      const double off = std::abs(coordinates(k) - joints_.stop_at(k, side));
      if (off <= rounding * reach(k) + within * std::abs(v_(k))) near_[k] = side;
    }
  for (const Event& event : met) {
    const int k = event.coordinate;
    if (event.of == Event::q_dot) rest_(k) = infinity;
    if (event.of == Event::q) near_[k] = event.value == joints_.table.lower(k) ? -1 : 1;
    slips_ |= event.of == Event::holding;
  }
  for (int k : joints_.locked) rest_(k) = infinity;
  const Indices held = joints_.locked;
  arrived_.clear();
  const Indices sign = joints_.sign;
  if (!known_)
    for (int k = 0; k < core_.n; ++k)
      if (joints_.rubs_at(k) && !rests(k)) joints_.sign[k] = v_(k) > 0.0 ? 1 : -1;
  if (!system_.before_change(t, y, arriving(met))) return false;
  joints_.sign = sign;
  joints_.rate_rounding = rounding * v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  std::optional<double> energy;
  if (!impact(t, y, energy) || !grip(t, y, held)) return false;
  // The loss of the rounds, and of the rates up to rounding that are taken from joints at rest after them.
  if (energy) joints_.impact_loss += *energy - core_.energy(v_, step_).kinetic;
  known_ = true;
  return system_.after_change(t, y, arrived_, tolerance_.rtol, tolerance_.atol);
}

// What holds gives way where nothing changes yet: at no time of its own. Where a joint rests at its stop, and nothing holds
// it there, that is when it does.
std::vector<System::Met> JointChanges::arriving(const std::vector<Event>& met) const {
  std::vector<System::Met> found;
  for (int k = 0; k < core_.n; ++k)
    if (is_into(k)) found.push_back({k, false, near_[k]});
  for (const Event& event : met) {
    const int k = event.coordinate;
    if (event.of == Event::q_dot) found.push_back({k, true});
    if (event.of != Event::q || is_into(k)) continue;
    if (!rests(k))
      found.push_back({k, false, near_[k]});
    else if (!joints_.is_locked(k))
      found.push_back({k, true});
  }
  return found;
}

bool JointChanges::hits(int k) const {
  return std::any_of(arrived_.begin(), arrived_.end(), [&](const auto& of) { return of.coordinate == k && of.stop; });
}

bool JointChanges::movable(Indices& at) {
  if (!core_.responses(at, responses_)) return false;
  Eigen::Index left = 0;
  for (size_t i = 0; i < at.size(); ++i) {
    const int k = at[i];
    const auto column = static_cast<Eigen::Index>(i);
    if (!(responses_(k, column) * core_.inertia_alone(k) > moves)) continue;
    at[left] = k;
    if (left != column) responses_.col(left) = responses_.col(column);
    ++left;
  }
  at.resize(left);
  return true;
}

void JointChanges::scale(const Indices& at) {
  const auto m = static_cast<Eigen::Index>(at.size());
  A_.resize(m, m), scale_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) scale_(i) = 1.0 / std::sqrt(responses_(at[i], i));
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j) A_(i, j) = scale_(i) * scale_(j) * responses_(at[i], j);
}

// What happens at the stops that joints are at, in the order in which it happens there (motion/impact.hpp). Joints that touch are
// in it too: what pushes them is an impact. Friction is bounded and has no impulse, so that joints that stick are let go.
bool JointChanges::impact(double t, Out y, std::optional<double>& energy) {
  Indices at;
  bool any = false;
  for (int k = 0; k < core_.n; ++k)
    if (near_[k]) at.push_back(k), any |= is_into(k);
  if (!any) return true;
  energy = core_.energy(v_, step_).kinetic;
  if (!system_.acceleration(t, held_)) return false;
  joints_.locked.clear();
  const Indices touched = std::exchange(joints_.touch, Indices(core_.n, 0));
  if (!system_.acceleration(t, a_) || !movable(at)) return false;
  const auto m = static_cast<Eigen::Index>(at.size());
  if (!m) return joints_.touch = touched, true;
  const Vector& reach = joints_.table.reach;
  // Back to the stop, by what holds others before or without it: a bounce that either way rises no further is none.
  const auto returning = [&](int k) { return std::max(near_[k] * a_(k), near_[k] * held_(k)); };
  const double fastest = v_.cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
  ImpactProblem problem;
  problem.A.resize(m, m), problem.g.resize(m), problem.restitution.resize(m), problem.at_rest.resize(m), problem.slow.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) {
    const int k = at[i], side = -near_[k];
    problem.g(i) = side * v_(k);
    problem.restitution(i) = joints_.table.restitution(k);
    problem.at_rest(i) = std::isfinite(rest_(k)) ? rest_(k) : rounding * fastest * reach(k);
    // A bounce has to rise higher than the joint is off its stop, or it is not seen to come back.
    const double rise = std::max(rise_ * reach(k), seen * std::abs(coordinates(k) - joints_.stop_at(k, near_[k])));
    problem.slow(i) = std::sqrt(2 * std::max(returning(k), 0.0) * rise);
    for (Eigen::Index j = 0; j < m; ++j) problem.A(i, j) = side * -near_[at[j]] * responses_(k, j);
  }
  std::vector<char> is_hit(at.size(), 0);
  Vector step = Vector::Zero(core_.n);
  const auto apply = [&](const Indices& stops, const Vector& impulses, double restitution) {
    const auto count = static_cast<Eigen::Index>(stops.size());
    Indices struck;
    Vector x(count);
    step_.setZero();
    for (Eigen::Index j = 0; j < count; ++j) {
      const int i = stops[j], k = at[i];
      struck.push_back(k);
      x(j) = -near_[k] * impulses(i);
      step_ += x(j) * responses_.col(i);
      if (impulses(i) > 0.0 && !is_hit[i] && !touched[k]) arrived_.push_back({k, false, near_[k]});
      is_hit[i] |= impulses(i) > 0.0;
    }
    step += step_;
    return system_.at_impact(step_, struck, responses_(Eigen::all, stops), x, restitution);
  };
  Vector gap_rates;
  if (!resolve_impact(problem, apply, gap_rates)) return false;
  system_.push(y, step);
  if (!take_state(t, y)) return false;
  rest_ = 10 * rounding * std::max(fastest, step.cwiseQuotient(reach).lpNorm<Eigen::Infinity>()) * reach;
  for (Eigen::Index i = 0; i < m; ++i) {
    const int k = at[i];
    const double towards = returning(k), off = gap_rates(i);
    if (off == 0.0) {
      joints_.touch[k] = near_[k], rest_(k) = infinity;
      if (!touched[k]) note(t, k, JointChange::touches, near_[k]);
    } else if (is_hit[i] || touched[k]) {
      note(t, k, touched[k] ? JointChange::leaves : JointChange::bounces, near_[k]);
      if (towards > 0.0) flight = std::min(flight, 2 * off / towards);
    }
    near_[k] = joints_.touch[k];
  }
  return true;
}

// Gauss' principle: of the accelerations that the loops and the stops allow, the one nearest in the metric of D' to that
// without what holds, less what friction takes, which is the problem of least forces between their bounds.
bool JointChanges::grip(double t, Out y, const Indices& before) {
  Indices at, locked;
  const Indices sign = joints_.sign, touch = joints_.touch;
  joints_.locked.clear();
  for (int k = 0; k < core_.n; ++k) {
    const bool rubs = joints_.rubs_at(k);
    const bool touches = near_[k] && rests(k);
    joints_.touch[k] = touches ? near_[k] : 0;
    joints_.sign[k] = rubs && !rests(k) ? (v_(k) > 0.0 ? 1 : -1) : 0;
    if (touches || (rubs && rests(k))) at.push_back(k);
  }
  if (!at.empty()) {
    if (!system_.acceleration(t, a_)) return false;
    // Where the loops leave a joint no way, as a slide at its dead centre, they turn it round or it does nothing.
    const double fastest = a_.cwiseQuotient(joints_.table.reach).lpNorm<Eigen::Infinity>();
    for (int k : at)
      if (joints_.rubs_at(k) && std::abs(a_(k)) > exactly * fastest * joints_.table.reach(k))
        joints_.sign[k] = a_(k) > 0.0 ? 1 : -1;
    const Indices all = at, touching = joints_.touch;
    if (!movable(at)) return false;
    for (int k : all) joints_.touch[k] = 0;
    for (int k : at) joints_.sign[k] = 0, joints_.touch[k] = touching[k];
  }
  const auto m = static_cast<Eigen::Index>(at.size());
  if (m) {
    scale(at);
    b_.resize(m), low_.resize(m), high_.resize(m);
    for (Eigen::Index i = 0; i < m; ++i) b_(i) = scale_(i) * a_(at[i]);
    double most = 0.0;  // that friction alone would accelerate
    for (Eigen::Index i = 0; i < m; ++i) most = std::max(most, joints_.table.friction(at[i]) / scale_(i));
    // What rounding makes of the accelerations keeps whatever is held.
    core_.acceleration_rounding(at, responses_, system_.acting(v_), a_, rounding_);
    rounding_ = rounding_.cwiseProduct(scale_);
    const double size = std::max({b_.lpNorm<Eigen::Infinity>(), negligible * most, rounding_.maxCoeff(), 1e-300});
    const double weaker = slips_ ? gives : 0.0;
    b_ /= size;
    // Rows that follow from others have accelerations that do, but for rounding, unless they do so here alone.
    const Eigen::SelfAdjointEigenSolver<Matrix> eigen(A_);
    const auto& values = eigen.eigenvalues();
    const auto project = [&](double tolerance) {
      for (Eigen::Index k = 0; k < m && values(k) <= dependent * values(m - 1); ++k) {
        const double beyond = eigen.eigenvectors().col(k).dot(b_);
        if (std::abs(beyond) <= tolerance) b_ -= beyond * eigen.eigenvectors().col(k);
      }
    };
    project(std::max({exactly, rounded * most / size, rounding_.norm() / size}));
    for (Eigen::Index i = 0; i < m; ++i) {
      const double low = joints_.lower_force(at[i]) / (scale_(i) * size), high = joints_.upper_force(at[i]) / (scale_(i) * size);
      const double less = std::min(weaker, 0.5 * (high - low));
      low_(i) = low + less, high_(i) = high - less;
    }
    // Without a solution, stops push against each other: the nearest accelerations that all of them allow are taken.
    if (!least_in_box(A_, b_, low_, high_, x_)) {
      project(infinity);
      if (!least_in_box(A_, b_, low_, high_, x_)) return false;
    }
    const Vector row = A_ * x_ + b_;  // accelerations
    for (Eigen::Index i = 0; i < m; ++i) {
      const int k = at[i];
      const double room = row(i) > 0.0 ? x_(i) - low_(i) : high_(i) - x_(i);  // or it: one of them is zero
      if (!(std::abs(row(i)) > std::max({exactly, room, rounding_(i) / size}))) {
        locked.push_back(k);
        continue;
      }
      if (!hits(k)) {
        arrived_.push_back({k, true});
        if (near_[k]) arrived_.push_back({k, false, near_[k]});
      }
      joints_.touch[k] = 0;
      if (joints_.rubs_at(k)) joints_.sign[k] = row(i) > 0.0 ? 1 : -1;
    }
  }
  joints_.lock(locked, coordinates);
  joints_.idle.clear();
  for (int k = 0; k < core_.n; ++k) {
    const bool holds = among(locked, k);
    if (joints_.touch[k] && !touch[k]) arrived_.push_back({k, false, joints_.touch[k]});
    if (joints_.touch[k] && !touch[k]) note(t, k, JointChange::touches, joints_.touch[k]);
    if (!joints_.touch[k] && touch[k]) note(t, k, JointChange::leaves, touch[k]);
    if (joints_.sign[k] && joints_.sign[k] != sign[k]) note(t, k, JointChange::slides, joints_.sign[k]);
    if (holds && !among(before, k) && !joints_.touch[k]) note(t, k, JointChange::sticks, 0);
    if (joints_.rubs_at(k) && !joints_.sign[k] && !holds) joints_.idle.push_back(k);
  }
  bool changed;
  if (!locked.empty() && !system_.keep_locked(y, 0.0, changed)) return false;
  if (!take_state(t, y)) return false;
  system_.go_on(t, y);
  return true;
}

}  // namespace ckc
