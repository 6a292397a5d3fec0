// How the change of a motion jumps where the motion, or its rate, does: saltation.
#include <algorithm>
#include <cmath>

#include <Eigen/QR>

#include "sensitivity/sensitivities.hpp"

namespace ckc {

constexpr double least = 1e-7, most = 1e-2, times = 100.0;  // relative, at least, at most, and of the tolerances: none
constexpr double rounding = 1e-9;  // of the fastest coordinate: one that does not move, but for rounding

Vector Variation::delay(const System::Met& met, In v, In a, const Matrix& s) const {
  const int k = met.coordinate;
  if (met.of_rate) return -s.row(n + k) / a(k);
  return -from_stop(met, s) / core_.tree.coordinate_step(core_.q_tree, k, v);
}

// Bring the changes back to what loops and locked joints allow, by what is least in the metric of D': they
// drift within the tolerances, and joints that move only together would come to rest at times of their own.
bool Variation::project_sensitivities(In v, Matrix& s) {
  const int m = core_.rows.closure.rows;
  const Vector none = Vector::Zero(n), no_force = Vector::Zero(m);
  const bool locked = !core_.joints.locked.empty();
  Matrix rate;
  compute(v, none, no_force, false);
  closure_changes(v, row_, rate);
  core_.tree_inertia(), core_.jacobian();
  force_.setZero();
  row_ += core_.rows.J * s.topRows(n);
  if (!core_.respond(force_, row_, change_) || (locked && !core_.responses(core_.joints.locked, responses_))) return false;
  if (locked) add_back(change_);
  s.topRows(n) += change_;
  for (int k = 0; k < n; ++k) rate += derivatives_.rate_by_q.col(table_.real_v[k]) * s.row(k);
  row_ = rate + core_.rows.J * s.bottomRows(n);
  if (!core_.respond(force_, row_, change_)) return false;
  change_ += s.bottomRows(n);
  if (locked) add_back(change_);
  s.bottomRows(n) = change_;
  return true;
}

double Variation::size(const Eigen::Ref<const Matrix>& s, int p) const {
  const Vector& reach = core_.joints.table.reach;
  return std::max(s.col(p).head(n).cwiseQuotient(reach).lpNorm<Eigen::Infinity>(),
                  s.col(p).tail(n).cwiseQuotient(reach).lpNorm<Eigen::Infinity>());
}

void Variation::measure(const Eigen::Ref<const Matrix>& s) {
  for (int p = 0; p < count; ++p) largest_(p) = std::max(largest_(p), size(s, p));
}

bool Variation::is_known(int coordinate, bool of_rate, In v, In a) const {
  const Vector& reach = core_.joints.table.reach;
  const Vector moves = (of_rate ? a : v).cwiseQuotient(reach).cwiseAbs();
  return moves(coordinate) > rounding * moves.maxCoeff();
}

void Variation::add_delayed(In v, In a, double sign, Matrix& s) const {
  for (int k = 0; k < n; ++k) {
    s.row(k) += sign * v(k) * delay_.row(table_.part[k]);
    s.row(n + k) += sign * a(k) * delay_.row(table_.part[k]);
  }
}

// What is met stays met. Of several the one that comes fastest tells when, a stop before what comes to rest. Parts of the
// mechanism that nothing connects have times of their own: the order in which they change makes no difference.
bool Variation::before_change(In v, In a, const std::vector<System::Met>& met, Matrix& s) {
  const Vector& reach = core_.joints.table.reach;
  const auto speed = [&](const System::Met& of) { return std::abs((of.of_rate ? a : v)(of.coordinate)) / reach(of.coordinate); };
  const auto later = [&](const System::Met& x, const System::Met& y) {
    return x.of_rate == y.of_rate ? speed(x) < speed(y) : x.of_rate;
  };
  sign_ = core_.joints.sign, touch_ = core_.joints.touch;
  locked_.assign(n, 0), struck_.assign(n, 0), missed_.clear();
  for (int k : core_.joints.locked) locked_[k] = 1;
  delay_.setZero();
  if (!project_sensitivities(v, s)) return false;
  measure(s);
  for (Eigen::Index part = 0; part < delay_.rows(); ++part) {
    const System::Met* first = nullptr;
    for (const System::Met& of : met)
      if (table_.part[of.coordinate] == part && is_known(of.coordinate, of.of_rate, v, a) && (!first || later(*first, of)))
        first = &of;
    if (first) delay_.row(part) = delay(*first, v, a, s);
  }
  add_delayed(v, a, 1.0, s);
  return s.allFinite();
}

// Of a joint that is at rest where another one changes what it does, as one that has just turned round, nothing changes.
bool Variation::has_changed(const System::Met& met) const {
  const Joints& joints = core_.joints;
  const int k = met.coordinate;
  const bool locked = joints.is_locked(k);
  return begins_ || struck_[k] || locked != static_cast<bool>(locked_[k]) || joints.sign[k] != sign_[k] ||
         joints.touch[k] != touch_[k];
}

// Each parameter is judged by its own column, as large as it has been: what that has lost in digits stays lost.
std::optional<Apart> Variation::apart(const std::vector<System::Met>& arrived, const Matrix& s, double rtol, double atol) {
  const double relative = std::clamp(times * rtol, least, most);
  measure(s);
  for (const auto& [k, missed] : missed_)
    for (int p = 0; p < count; ++p)
      if (!(std::abs(missed(p)) <= core_.joints.table.reach(k) * (relative * largest_(p) + times * atol)))
        return Apart{{k, false}, p, Apart::restitution};
  if (begins_)
    for (int p = 0; p < count; ++p)
      if (const int k = table_.parameters[p].assembled_at; k >= 0) return Apart{{k, false}, p};
  for (const System::Met& met : arrived) {
    if (!has_changed(met)) continue;
    const double reach = core_.joints.table.reach(met.coordinate);
    const Vector off = (met.of_rate ? Vector(s.row(n + met.coordinate)) : from_stop(met, s)) / reach;
    for (int p = 0; p < count; ++p)
      if (!(std::abs(off(p)) <= relative * largest_(p) + times * atol)) return Apart{met, p};
  }
  return {};
}

std::optional<Apart> Variation::let_go(double atol) {
  const Joints& joints = core_.joints;
  std::vector<char> before(n, 0);
  std::swap(before, at_limit_);
  before.resize(n, 0);
  std::optional<Apart> first;
  for (int i : core_.at_limit()) {
    const int k = joints.locked[i];
    at_limit_[k] = 1;
    if (!before[k] || first) continue;
    const Vector& reach = joints.table.reach;
    for (int p = 0; p < count && !first; ++p) {
      const double largest = free_.col(p).cwiseQuotient(reach).lpNorm<Eigen::Infinity>();
      const double side = joints.touch[k] ? joints.touch[k] : std::copysign(1.0, joints.forces()(i));
      double room = -side * back_forces_(i, p);  // how the distance from the limit changes, N or N m
      for (const Effect& of : table_.parameters[p].effects)
        if (of.kind == Effect::friction && of.index == k) room += 1.0;
      if (std::abs(responses_(k, i) * room) > reach(k) * (least * largest + times * atol)) first = Apart{{k, true, joints.touch[k]}, p, Apart::let_go};
    }
  }
  return first;
}

// What sticks or touches from here on is brought to rest by what holds it, whenever it comes: a friction that could hold
// more, or the last of ever smaller bounces, takes a time and a way that vanish with the rate it comes with.
void Variation::after_change(In v, In a, Matrix& s) {
  at_limit_.clear();
  limits_.clear();  // a velocity that jumps may be answered by other torques at once
  begins_ = false;
  add_delayed(v, a, -1.0, s);
}

// D' step = J^T mu + x, J step = 0, and the speeds that x turns round go on in that proportion.
bool Variation::at_impact(In v, In step, const Indices& at, const Matrix& responses, In x, double restitution, Matrix& s) {
  const int m = core_.rows.closure.rows;
  const Vector none = Vector::Zero(n);
  Vector lambda = Vector::Zero(m), lacking(n);
  core_.tree_inertia();
  core_.D_times(step, lacking);
  Indices pushed;
  for (size_t i = 0; i < at.size(); ++i) {
    const auto k = static_cast<Eigen::Index>(i);
    lacking(at[i]) -= x(k);
    struck_[at[i]] = 1;
    // Either a stop pushes, or the joint goes off it faster than it is thrown back; the other one is rounding. A joint that
    // is turned round may leave the push to others that move only with it.
    const double before = v(at[i]), after = before + step(at[i]), faster = std::abs(after + restitution * before);
    const bool turned = is_known(at[i], false, v, v) && before * step(at[i]) < 0.0;
    if (std::abs(x(k)) * responses(at[i], k) > faster || (turned && faster <= rounding * std::abs(before)))
      pushed.push_back(static_cast<int>(i));
  }
  core_.multipliers(lacking, lambda);
  compute(none, step, lambda, true);
  force_.setZero(n, count), row_.setZero(m, count);
  add_parameters(none, step, lambda, true, force_, row_);
  Matrix places = s;
  places.bottomRows(n).setZero();
  add_state(places);
  if (!core_.respond(-force_, row_, change_)) return false;
  const auto few = static_cast<Eigen::Index>(pushed.size());
  Matrix A(few, few), wanted(few, count), columns(n, few);
  Vector scale(few);
  for (Eigen::Index i = 0; i < few; ++i) {
    const int k = at[pushed[i]];
    columns.col(i) = responses.col(pushed[i]);
    for (Eigen::Index j = 0; j < few; ++j) A(i, j) = responses(k, pushed[j]);
    scale(i) = 1.0 / std::sqrt(A(i, i));
    const double side = x(pushed[i]) > 0.0 || (x(pushed[i]) == 0.0 && v(k) < 0.0) ? 1.0 : -1.0;  // off the stop
    wanted.row(i) = -(1.0 + restitution) * s.row(n + k) - change_.row(k);
    for (int p = 0; p < count; ++p)
      for (const Effect& of : table_.parameters[p].effects)
        if (of.kind == Effect::restitution && of.index == k && restitution == core_.joints.table.restitution(k))
          wanted(i, p) += side * std::max(-side * v(k), 0.0);
  }
  A = scale.asDiagonal() * A * scale.asDiagonal(), wanted = scale.asDiagonal() * wanted;
  Eigen::CompleteOrthogonalDecomposition<Matrix> solver(few, few);
  solver.setThreshold(dependent).compute(A);
  const Matrix impulse = solver.solve(wanted);
  s.bottomRows(n) += change_ + columns * scale.asDiagonal() * impulse;
  // Joints that move only together, each thrown back by its own stop: with another restitution one of them takes over.
  const Matrix missed = scale.cwiseInverse().asDiagonal() * (A * impulse - wanted);
  for (Eigen::Index i = 0; i < few; ++i) missed_.emplace_back(at[pushed[i]], missed.row(i));
  return s.allFinite();
}

}  // namespace ckc
