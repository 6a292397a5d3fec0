// How the change of a motion jumps where the motion, or its rate, does: saltation.
#include <cmath>

#include <Eigen/QR>

#include "variation.hpp"

namespace ckc {

constexpr double same = 1e-6;  // relative: two events at once that come at the same time whatever the parameters are

// When what was met comes with another parameter: its function stays at zero.
bool Variation::delays(In v, In a, const std::vector<System::Met>& met, const Matrix& s) {
  bool known = false;
  delay_.setZero();
  for (const auto& [k, of_rate] : met) {
    Vector found(count);
    for (int p = 0; p < count; ++p) {
      const bool stop = !of_rate && is_of_stop(table_.parameters[p], k, v(k));
      found(p) = of_rate ? -s(n + k, p) / a(k) : -(s(k, p) - (stop ? 1.0 : 0.0)) / v(k);
    }
    if (known && !((found - delay_).norm() <= same * delay_.norm())) return false;
    delay_ = found, known = true;
  }
  return delay_.allFinite();
}

bool Variation::before_change(In v, In a, const std::vector<System::Met>& met, Matrix& s) {
  if (!delays(v, a, met, s)) return false;
  s.topRows(n) += v * delay_.transpose();
  s.bottomRows(n) += a * delay_.transpose();
  return true;
}

void Variation::after_change(In v, In a, Matrix& s) {
  s.topRows(n) -= v * delay_.transpose();
  s.bottomRows(n) -= a * delay_.transpose();
}

// D' step = J^T mu + x, J step = 0, and the speeds that x turns round go on in that proportion.
bool Variation::at_impact(In step, const Indices& at, const Matrix& responses, In x, In back, Matrix& s) {
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
    const double again = back(pushed[i]) > 0.0 ? core_.joints.table.restitution(k) : 0.0;
    wanted.row(i) = -(1.0 + again) * s.row(n + k) - change_.row(k);
    for (int p = 0; p < count; ++p) {
      const double speed = again > 0.0 ? back(pushed[i]) / again : 0.0;  // off the stop
      const double side = x(pushed[i]) > 0.0 ? 1.0 : -1.0;
      for (const Effect& of : table_.parameters[p].effects)
        if (of.kind == Effect::restitution && of.index == k) wanted(i, p) += side * speed;
    }
  }
  s.bottomRows(n) += change_ + columns * A.completeOrthogonalDecomposition().solve(wanted);
  return s.allFinite();
}

}  // namespace ckc
