#include "joints.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/LU>

namespace ckc {

constexpr double still = 1e-11;      // of a motion that the rows allow: a joint does not take part in it
constexpr long most_ways = 20000;    // of slipping that are compared

Joints::Joints(JointTable table_, int n)
    : table(std::move(table_)),
      rubs(table.smoothing == 0.0 && !table.friction.isZero(0)),
      stops(table.lower.array().isFinite().any() || table.upper.array().isFinite().any()),
      sign(n, 0),
      touch(n, 0),
      smooth_(table.smoothing != 0.0 && !table.friction.isZero(0)) {
  place.setZero(n), since_.setZero(n);
}

void Joints::begin() {
  std::fill(sign.begin(), sign.end(), 0), std::fill(touch.begin(), touch.end(), 0);
  locked.clear(), idle.clear(), changes.clear();
  impact_loss = rubbed_ = 0.0;
}

void Joints::add_friction(In v, Out force) const {
  for (Eigen::Index k = 0; k < v.size(); ++k)
    if (smooth_)
      force(k) -= table.friction(k) * std::tanh(v(k) / table.smoothing);
    else if (sign[k])
      force(k) -= table.friction(k) * sign[k];
}

void Joints::add_slopes(In v, Out slopes) const {
  if (!smooth_) return;
  for (Eigen::Index k = 0; k < v.size(); ++k) {
    const double part = std::tanh(v(k) / table.smoothing);
    slopes(k) -= table.friction(k) / table.smoothing * (1.0 - part * part);
  }
}

double Joints::passed(In q_tree, const Indices& at) const {
  double most = 0.0;
  if (stops)
    for (size_t k = 0; k < at.size(); ++k) {
      const double x = q_tree(at[k]);
      most = std::max(most, std::max(table.lower(k) - x, x - table.upper(k)) / table.reach(k));
    }
  return most;
}

void Joints::account(In coordinates) { rubbed_ = dissipated(coordinates) - impact_loss, since_ = coordinates; }

void Joints::lock(Indices which, In coordinates) {
  locked = std::move(which);
  for (int k : locked) place(k) = touch[k] ? stop_at(k, touch[k]) : coordinates(k);
}

double Joints::dissipated(In coordinates) const {
  double work = rubbed_ + impact_loss;
  for (size_t k = 0; k < sign.size(); ++k)
    if (sign[k]) work += table.friction(k) * sign[k] * (coordinates(k) - since_(k));
  return work;
}

void Joints::factor(const Matrix& responses) {
  const auto m = static_cast<Eigen::Index>(locked.size());
  A_.resize(m, m), scale_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) scale_(i) = 1.0 / std::sqrt(std::max(responses(locked[i], i), 1e-300));
  for (Eigen::Index i = 0; i < m; ++i)
    for (Eigen::Index j = 0; j < m; ++j)
      A_(i, j) = 0.5 * scale_(i) * scale_(j) * (responses(locked[i], j) + responses(locked[j], i));
  eigen_.compute(A_);
  Eigen::Index rank = 0;
  const auto& values = eigen_.eigenvalues();
  while (rank < m && values(m - 1 - rank) > dependent * values(m - 1)) ++rank;
  root_ = eigen_.eigenvectors().rightCols(rank) * values.tail(rank).cwiseSqrt().asDiagonal();
}

// The least forces, each measured in what it takes to move its own joint, that make the rows x.
void Joints::least_forces(const Matrix& responses, In x, Vector& force) {
  factor(responses);
  const auto m = static_cast<Eigen::Index>(locked.size());
  wanted_.resize(m);
  for (Eigen::Index i = 0; i < m; ++i) wanted_(i) = -scale_(i) * x(locked[i]);
  const Eigen::Index rank = root_.cols();
  const auto vectors = eigen_.eigenvectors().rightCols(rank);
  const Vector along = (vectors.transpose() * wanted_).cwiseQuotient(eigen_.eigenvalues().tail(rank));
  force.noalias() = vectors * along;
  for (Eigen::Index i = 0; i < m; ++i) force(i) *= scale_(i);
}

void Joints::back(const Matrix& responses, In x, Out step) {
  least_forces(responses, x, back_);
  step.noalias() = responses.leftCols(back_.size()) * back_;
}

void Joints::hold(const Matrix& responses, Out a) {
  least_forces(responses, a, force_);
  a.noalias() += responses.leftCols(force_.size()) * force_;
  for (int k : locked) a(k) = 0.0;  // what is left is rounding
}

// The rows hold as long as along every motion that they allow to begin, the forces that are needed do less work than
// those that there are at most. The work left is concave along each edge of the cone where the same joints move the same
// way, so that it is least on one of its extreme motions, along which all but as few of them rest as can be.
double Joints::margin() {
  const Eigen::Index m = root_.rows(), rank = root_.cols();
  double least = infinite;
  if (rank == m) {  // each joint can move alone
    const Matrix inverse = eigen_.eigenvalues().cwiseSqrt().cwiseInverse().asDiagonal() * eigen_.eigenvectors().transpose();
    for (Eigen::Index i = 0; i < m; ++i) {
      const double room = std::min(force_(i) - lower_force(locked[i]), upper_force(locked[i]) - force_(i));
      least = std::min(least, room / (scale_(i) * inverse.col(i).norm()));
    }
    return least;
  }
  std::vector<Eigen::Index> rest(rank - 1);
  for (Eigen::Index i = 0; i < rank - 1; ++i) rest[i] = i;
  Matrix rows(rank - 1, rank);
  Vector direction(rank);
  for (long ways = 0; ways < most_ways; ++ways) {
    if (rank == 1) {
      direction(0) = 1.0;
    } else {
      for (Eigen::Index i = 0; i < rank - 1; ++i) rows.row(i) = root_.row(rest[i]);
      const Eigen::FullPivLU<Matrix> lu(rows);
      if (lu.rank() < rank - 1)
        direction.setZero();
      else
        direction = lu.kernel().col(0).normalized();
    }
    if (!direction.isZero(0)) least = std::min({least, slack(direction), slack(-direction)});
    Eigen::Index k = rank - 2;  // the next choice of joints that rest
    while (k >= 0 && rest[k] == m - (rank - 1) + k) --k;
    if (k < 0) break;
    ++rest[k];
    for (Eigen::Index j = k + 1; j < rank - 1; ++j) rest[j] = rest[j - 1] + 1;
  }
  return std::isfinite(least) ? least : 1.0;
}

double Joints::slack(In direction) const {
  const Vector motion = root_ * direction;
  double work = 0.0;
  for (Eigen::Index i = 0; i < motion.size(); ++i) {
    if (std::abs(motion(i)) <= still) continue;
    const double most = motion(i) > 0 ? lower_force(locked[i]) : upper_force(locked[i]);
    if (!std::isfinite(most)) return infinite;
    work += (force_(i) - most) / scale_(i) * motion(i);
  }
  return work;
}

}  // namespace ckc
