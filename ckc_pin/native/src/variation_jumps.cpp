// How the change of a motion jumps where the motion, or its rate, does: saltation.
#include <algorithm>
#include <cmath>

#include <Eigen/QR>

#include "variation.hpp"

namespace ckc {

constexpr double least = 1e-7, most = 1e-2, times = 100.0;  // relative, at least, at most, and of the tolerances: none

Vector Variation::delay(const System::Met& met, In v, In a, const Matrix& s) const {
  const int k = met.coordinate;
  if (met.of_rate) return -s.row(n + k) / a(k);
  return -from_stop(met, s) / core_.tree.coordinate_step(core_.q_tree, k, v);
}

// Bring the changes back to what loops and locked joints allow, by what is least in the metric of D': they
// drift within the tolerances, and joints that move only together would come to rest at times of their own.
bool Variation::tidy(In v, Matrix& s) {
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

// What is met stays met. Of several the one that comes fastest tells when, a stop before what comes to rest.
bool Variation::before_change(In v, In a, const std::vector<System::Met>& met, Matrix& s) {
  const Vector& reach = core_.joints.table.reach;
  const auto speed = [&](const System::Met& of) { return std::abs((of.of_rate ? a : v)(of.coordinate)) / reach(of.coordinate); };
  const auto later = [&](const System::Met& x, const System::Met& y) {
    return x.of_rate == y.of_rate ? speed(x) < speed(y) : x.of_rate;
  };
  delay_.setZero();
  if (!tidy(v, s)) return false;
  if (!met.empty()) delay_ = delay(*std::max_element(met.begin(), met.end(), later), v, a, s);
  if (!delay_.allFinite()) delay_.setZero();  // what neither moves nor is moved has no time of its own
  s.topRows(n) += v * delay_.transpose();
  s.bottomRows(n) += a * delay_.transpose();
  return s.allFinite();
}

std::optional<Apart> Variation::apart(const std::vector<System::Met>& arrived, const Matrix& s, double rtol,
                                      double atol) const {
  const double relative = std::clamp(times * rtol, least, most);
  for (const System::Met& met : arrived) {
    const Vector off = met.of_rate ? Vector(s.row(n + met.coordinate)) : from_stop(met, s);
    for (int p = 0; p < count; ++p)
      if (!(std::abs(off(p)) <= relative * s.col(p).lpNorm<Eigen::Infinity>() + times * atol)) return Apart{met, p};
  }
  return {};
}

// What sticks or touches from here on is brought to rest by what holds it, whenever it comes: a friction that could hold
// more, or the last of ever smaller bounces, takes a time and a way that vanish with the rate it comes with.
bool Variation::after_change(In v, In a, Matrix& s) {
  limits_.clear();  // a velocity that jumps may be answered by other torques at once
  if (!tidy(v, s)) return false;
  s.topRows(n) -= v * delay_.transpose();
  s.bottomRows(n) -= a * delay_.transpose();
  return true;
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
    if (x(k) != 0.0) pushed.push_back(static_cast<int>(i));
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
  for (Eigen::Index i = 0; i < few; ++i) {
    const int k = at[pushed[i]];
    columns.col(i) = responses.col(pushed[i]);
    for (Eigen::Index j = 0; j < few; ++j) A(i, j) = responses(k, pushed[j]);
    const double side = x(pushed[i]) > 0.0 ? 1.0 : -1.0;  // off the stop
    wanted.row(i) = -(1.0 + restitution) * s.row(n + k) - change_.row(k);
    for (int p = 0; p < count; ++p)
      for (const Effect& of : table_.parameters[p].effects)
        if (of.kind == Effect::restitution && of.index == k && restitution == core_.joints.table.restitution(k)) wanted(i, p) += side * std::max(-side * v(k), 0.0);
  }
  s.bottomRows(n) += change_ + columns * A.completeOrthogonalDecomposition().solve(wanted);
  return s.allFinite();
}

}  // namespace ckc
