// Eq. 1 where masses are very unequal.
//
// T^T D' T adds what heavy and light bodies bring to each pair of directions. Directions along which only light bodies move are
// then known to the rounding of the heavy ones: with masses of a ratio 1e9 and a heavy load at the end of a chain, to seven
// digits. Here directions are sorted by what they move: the first ones move the heaviest bodies, all others leave these where
// they are, and so on. To an entry of D' of two directions only those bodies contribute that both may move.
#include <algorithm>
#include <cmath>
#include <numeric>

#include <Eigen/Eigenvalues>

#include "loops/core.hpp"

namespace ckc {

constexpr double spread = 1e5;        // ratio of masses from which rounding is looked at
constexpr double gap = 1e3;           // ratio of weights within a level
constexpr double unmoved = 1e-13;     // relative to what moves most in a level: rounding

bool Core::has_uneven_masses() const {
  double least = std::numeric_limits<double>::infinity(), most = 0.0;
  for (int joint = 1; joint < tree.joints; ++joint) {
    const double mass = tree.body(joint).mass;
    if (mass > 0.0) least = std::min(least, mass), most = std::max(most, mass);
  }
  return most > spread * least && n > rank;
}

// Bodies as six components each, of the centre's velocity and of the angular velocity along the principal axes: `moved` is by how
// much each tangent direction moves one, `rate` what its acceleration is without them, gravity taken off, `load` the moment that
// its rotation takes. `size` is the inertia that it brings to directions, of three components alike: one that no direction moves
// here, though it is heavy, is not a light one.
struct Core::Components {
  std::vector<double> weight, rate, load, size;
  std::vector<Vector> moved;
};

void Core::components(Components& of) {
  set_tree();
  tree.bias(q_tree, v_tree);
  Vector units(n - rank);
  for (int k = 0; k < n - rank; ++k) units(k) = scales.columns(free_[k]);
  const Vector3 gravity = tree.field().head<3>();
  Eigen::Matrix<double, 3, Eigen::Dynamic> along(3, n);
  const auto add = [&](const Vector3& weight, const Vector3& rate, const Vector3& load) {
    const Matrix moved = along * tangent_;
    const Vector3 rates = rate + along * x_;
    const double most = (moved * units.asDiagonal()).cwiseAbs().maxCoeff();
    for (int axis = 0; axis < 3; ++axis) {
      if (!(weight(axis) * most * most > 0.0)) continue;
      of.weight.push_back(weight(axis)), of.rate.push_back(rates(axis)), of.load.push_back(load(axis));
      of.size.push_back(weight(axis) * most * most), of.moved.push_back(moved.row(axis).transpose());
    }
  };
  for (int joint = 1; joint < tree.joints; ++joint) {
    const Tree::Body body = tree.body(joint);
    if (!(body.mass > 0.0)) continue;
    const Vector6 twist = tree.velocity(joint), rate = tree.acceleration(joint);
    const Vector3 turn = twist.tail<3>(), speed = twist.head<3>() + turn.cross(body.centre);
    const Vector3 pull = rate.head<3>() + rate.tail<3>().cross(body.centre) + turn.cross(speed) - gravity;
    along.setZero();
    for (int k : tree.support[joint]) {
      const Vector6 direction = tree.jacobian().col(k);
      along.col(k) = direction.head<3>() + direction.tail<3>().cross(body.centre);
    }
    add(Vector3::Constant(body.mass), pull, Vector3::Zero());
    const Eigen::SelfAdjointEigenSolver<Matrix3> principal(body.inertia);
    const Matrix3 axes = principal.eigenvectors().transpose();
    along.setZero();
    for (int k : tree.support[joint]) along.col(k) = axes * tree.jacobian().col(k).tail<3>();
    add(principal.eigenvalues(), axes * rate.tail<3>(), axes * turn.cross(Vector3(body.inertia * turn)));
  }
}

bool Core::project_by_levels(In u_tree, Out a) {
  Components of;
  components(of);
  const int d_ = n - rank, count = static_cast<int>(of.weight.size());
  Indices order(count), level(count);
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(), [&](int i, int k) { return of.size[i] > of.size[k]; });
  Matrix basis(d_, d_), left = Matrix::Identity(d_, d_);
  Indices level_of;  // by column of the basis
  int levels = 0;
  for (int first = 0, last; first < count; first = last, ++levels) {
    for (last = first; last < count && of.size[order[last]] * gap >= of.size[order[first]]; ++last) level[order[last]] = levels;
    const auto free = left.cols();
    if (!free) continue;
    Matrix seen(free, last - first);
    for (int k = first; k < last; ++k)
      seen.col(k - first).noalias() = std::sqrt(of.weight[order[k]]) * (left.transpose() * of.moved[order[k]]);
    const Eigen::ColPivHouseholderQR<Matrix> qr(seen);
    const auto pivots = qr.matrixQR().diagonal().cwiseAbs();
    const double largest = std::sqrt(of.size[order[first]]);
    Eigen::Index found = 0;
    while (found < pivots.size() && pivots(found) > unmoved * largest) ++found;
    const Matrix turned = left * Matrix(qr.householderQ());
    basis.middleCols(d_ - free, found) = turned.leftCols(found);
    level_of.resize(level_of.size() + static_cast<size_t>(found), levels);
    left = turned.rightCols(free - found);
  }
  if (left.cols()) return false;  // what moves no mass
  Matrix moved(count, d_), D_levels(d_, d_);
  for (int r = 0; r < count; ++r) moved.row(r).noalias() = of.moved[r].transpose() * basis;
  const Matrix directions = tangent_ * basis;
  if (springs.any) spring_forces();
  else elastic_.setZero();
  y_ = u_tree + elastic_ + damping_tree - tree.armature().cwiseProduct(x_);
  Vector force = directions.transpose() * y_;
  D_levels.noalias() = directions.transpose() * tree.armature().asDiagonal() * directions;
  for (int i = 0; i < d_; ++i)
    for (int r = 0; r < count; ++r) {
      if (level[r] < level_of[i]) continue;
      force(i) -= (of.weight[r] * of.rate[r] + of.load[r]) * moved(r, i);
      for (int k = 0; k <= i; ++k) D_levels(i, k) += of.weight[r] * moved(r, i) * moved(r, k);
    }
  const Vector scale = D_levels.diagonal().cwiseSqrt().cwiseInverse();
  const Matrix scaled = scale.asDiagonal() * D_levels * scale.asDiagonal();
  const Eigen::LLT<Matrix> factor(scaled);
  if (factor.info() != Eigen::Success) return false;
  force = scale.cwiseProduct(factor.solve(scale.cwiseProduct(force)));
  a = x_ + directions * force;
  return finite(a);
}

}  // namespace ckc
