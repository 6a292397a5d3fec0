// Acceleration of eq. 1 for mechanisms with very unequal masses.
//
// T^T D' T adds the contributions of heavy and light bodies for each pair of tangent directions. The entries of
// directions that move light bodies only are then as inexact as the rounding of the heavy ones: seven digits remain if
// masses differ by 1e9 and a heavy load is at the end of a chain. Here the directions are sorted into levels. Those of
// the first level move the heaviest bodies, all others leave these at rest, and so on. An entry of D' then contains
// contributions of those bodies only that both directions move.
#include <algorithm>
#include <cmath>
#include <numeric>

#include <Eigen/Eigenvalues>

#include "loops/core.hpp"

namespace ckc {

constexpr double min_mass_ratio = 1e5;      // ratio of masses above which rounding is checked
constexpr double max_level_ratio = 1e3;     // ratio of inertias within a level
constexpr double motion_tolerance = 1e-13;  // rounding of a motion, relative to the largest one in its level

bool Core::has_uneven_masses() const {
  double lightest = std::numeric_limits<double>::infinity(), heaviest = 0.0;
  for (int joint = 1; joint < tree.joints; ++joint) {
    const double mass = tree.body(joint).mass;
    if (mass > 0.0) lightest = std::min(lightest, mass), heaviest = std::max(heaviest, mass);
  }
  return heaviest > min_mass_ratio * lightest && n > rank;
}

// Six velocity components per body: of the centre of mass in world axes, and of the angular velocity in principal axes.
struct Core::Components {
  std::vector<double> weight;  // mass or moment of inertia
  std::vector<double> rate;    // acceleration without tangent motion, minus gravity
  std::vector<double> load;    // gyroscopic moment
  // Inertia that the component contributes at most. The three components of a kind share it, so that a heavy body that
  // no direction moves along one axis does not count as light.
  std::vector<double> size;
  std::vector<Vector> motion;  // component per tangent direction
};

void Core::body_velocity_components(Components& of) {
  update_tree();
  tree.compute_bias(q_tree, v_tree);
  Vector units(n - rank);
  for (int k = 0; k < n - rank; ++k) units(k) = scales.columns(basis_coordinates_[k]);
  const Vector3 gravity = tree.spatial_gravity().head<3>();
  Eigen::Matrix<double, 3, Eigen::Dynamic> velocity_by_direction(3, n);
  const auto add = [&](const Vector3& weight, const Vector3& rate, const Vector3& load) {
    const Matrix motion = velocity_by_direction * tangent_;
    const Vector3 rates = rate + velocity_by_direction * x_;
    const double heaviest = (motion * units.asDiagonal()).cwiseAbs().maxCoeff();
    for (int axis = 0; axis < 3; ++axis) {
      if (!(weight(axis) * heaviest * heaviest > 0.0)) continue;
      of.weight.push_back(weight(axis)), of.rate.push_back(rates(axis)), of.load.push_back(load(axis));
      of.size.push_back(weight(axis) * heaviest * heaviest), of.motion.push_back(motion.row(axis).transpose());
    }
  };
  for (int joint = 1; joint < tree.joints; ++joint) {
    const Tree::Body body = tree.body(joint);
    if (!(body.mass > 0.0)) continue;
    const Vector6 twist = tree.velocity(joint), rate = tree.bias_acceleration(joint);
    const Vector3 omega = twist.tail<3>(), speed = twist.head<3>() + omega.cross(body.centre);
    const Vector3 acceleration = rate.head<3>() + rate.tail<3>().cross(body.centre) + omega.cross(speed) - gravity;
    velocity_by_direction.setZero();
    for (int k : tree.support[joint]) {
      const Vector6 direction = tree.jacobian().col(k);
      velocity_by_direction.col(k) = direction.head<3>() + direction.tail<3>().cross(body.centre);
    }
    add(Vector3::Constant(body.mass), acceleration, Vector3::Zero());
    const Eigen::SelfAdjointEigenSolver<Matrix3> principal(body.inertia);
    const Matrix3 axes = principal.eigenvectors().transpose();
    velocity_by_direction.setZero();
    for (int k : tree.support[joint]) velocity_by_direction.col(k) = axes * tree.jacobian().col(k).tail<3>();
    add(principal.eigenvalues(), axes * rate.tail<3>(), axes * omega.cross(Vector3(body.inertia * omega)));
  }
}

bool Core::project_by_mass_levels(In u_tree, Out a) {
  Components of;
  body_velocity_components(of);
  const int freedoms = n - rank, count = static_cast<int>(of.weight.size());
  Indices order(count), level(count);
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(), [&](int i, int k) { return of.size[i] > of.size[k]; });
  Matrix basis(freedoms, freedoms), remaining = Matrix::Identity(freedoms, freedoms);
  Indices level_of;  // by column of the basis
  int levels = 0;
  for (int first = 0, last; first < count; first = last, ++levels) {
    for (last = first; last < count && of.size[order[last]] * max_level_ratio >= of.size[order[first]]; ++last)
      level[order[last]] = levels;
    const auto free = remaining.cols();
    if (!free) continue;
    Matrix weighted_motion(free, last - first);
    for (int k = first; k < last; ++k)
      weighted_motion.col(k - first).noalias() =
          std::sqrt(of.weight[order[k]]) * (remaining.transpose() * of.motion[order[k]]);
    const Eigen::ColPivHouseholderQR<Matrix> qr(weighted_motion);
    const auto pivots = qr.matrixQR().diagonal().cwiseAbs();
    const double largest = std::sqrt(of.size[order[first]]);
    Eigen::Index motion_rank = 0;
    while (motion_rank < pivots.size() && pivots(motion_rank) > motion_tolerance * largest) ++motion_rank;
    const Matrix rotated = remaining * Matrix(qr.householderQ());
    basis.middleCols(freedoms - free, motion_rank) = rotated.leftCols(motion_rank);
    level_of.resize(level_of.size() + static_cast<size_t>(motion_rank), levels);
    remaining = rotated.rightCols(free - motion_rank);
  }
  if (remaining.cols()) return false;  // some direction moves no mass
  Matrix motion(count, freedoms), D_levels(freedoms, freedoms);
  for (int r = 0; r < count; ++r) motion.row(r).noalias() = of.motion[r].transpose() * basis;
  const Matrix directions = tangent_ * basis;
  if (springs.has_elastic_forces)
    compute_spring_forces();
  else
    elastic_.setZero();
  const Matrix rotors = tree.rotor_inertia();
  y_ = u_tree + elastic_ + damping_tree - rotors * x_;
  Vector force = directions.transpose() * y_;
  D_levels.noalias() = directions.transpose() * rotors * directions;
  for (int i = 0; i < freedoms; ++i)
    for (int r = 0; r < count; ++r) {
      if (level[r] < level_of[i]) continue;
      force(i) -= (of.weight[r] * of.rate[r] + of.load[r]) * motion(r, i);
      for (int k = 0; k <= i; ++k) D_levels(i, k) += of.weight[r] * motion(r, i) * motion(r, k);
    }
  const Vector scale = D_levels.diagonal().cwiseSqrt().cwiseInverse();
  const Matrix scaled = scale.asDiagonal() * D_levels * scale.asDiagonal();
  const Eigen::LLT<Matrix> factorization(scaled);
  if (factorization.info() != Eigen::Success) return false;
  force = scale.cwiseProduct(factorization.solve(scale.cwiseProduct(force)));
  a = x_ + directions * force;
  return finite(a);
}

}  // namespace ckc
