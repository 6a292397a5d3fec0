#include "loops/chart.hpp"

#include <algorithm>

#include <Eigen/LU>

#include "tree/rotation.hpp"

namespace ckc {

constexpr double max_rotation_from_reference = 1.0;  // rad; the chart is singular at 2 pi

static Vector3 triple(In x, const int* at) { return {x(at[0]), x(at[1]), x(at[2])}; }

static void put_triple(const Vector3& triple, const int* at, Out x) {
  for (int i = 0; i < 3; ++i) x(at[i]) = triple(i);
}

void Chart::reset(const Core& core, In q_tree) {
  roots_.clear();
  for (const auto& root : core.tree.roots) {
    const auto place = [&](int k) {
      return static_cast<int>(std::find(core.q.begin(), core.q.end(), root.v + k) - core.q.begin());
    };
    if (place(0) == core.d) continue;
    roots_.push_back({root, {}, core.tree.orientation(q_tree, root)});
    for (int k = 0; k < 6; ++k) roots_.back().k[k] = place(k);
  }
}

void Chart::coordinates(const Core& core, In q_tree, Out coordinates) const {
  for (int k = 0; k < core.d; ++k) coordinates(k) = q_tree(core.tree.q_index[core.q[k]]);
  for (const Root& root : roots_) {
    put_triple(q_tree.segment<3>(root.at.q), root.k, coordinates);
    put_triple(log3(root.reference.transpose() * core.tree.orientation(q_tree, root.at)), root.k + 3, coordinates);
  }
}

void Chart::tangent_step(const Core& core, In q_tree, In coordinates, Out step) const {
  for (int k = 0; k < core.d; ++k) step(k) = coordinates(k) - q_tree(core.tree.q_index[core.q[k]]);
  for (const Root& root : roots_) {
    const Vector6 twist = core.tree.twist_to(q_tree, root.at, root.reference * exp3(triple(coordinates, root.k + 3)),
                                             triple(coordinates, root.k));
    put_triple(twist.head<3>(), root.k, step), put_triple(twist.tail<3>(), root.k + 3, step);
  }
}

void Chart::coordinate_rates(const Core& core, In q_tree, In q_dot, Out rate) const {
  rate = q_dot;
  for (const Root& root : roots_) {
    const Matrix3 orientation = core.tree.orientation(q_tree, root.at);
    put_triple(orientation * triple(q_dot, root.k), root.k, rate);
    put_triple(Jlog3(root.reference.transpose() * orientation) * triple(q_dot, root.k + 3), root.k + 3, rate);
  }
}

void Chart::transform_jacobian(const Core& core, In q_tree, In q_dot, Matrix& jacobian) const {
  const int d = core.d;
  // coordinates_dot = rates q_dot; rate_by_q: its derivative with respect to tangent steps of q
  Matrix rates = Matrix::Identity(d, d), rate_by_q = Matrix::Zero(d, d);
  for (const Root& root : roots_) {
    const Matrix3 orientation = core.tree.orientation(q_tree, root.at);
    const LogJacobian log(log3(root.reference.transpose() * orientation));
    const Vector3 translation = triple(q_dot, root.k), rotation_rate = triple(q_dot, root.k + 3);
    for (int i = 0; i < 3; ++i) {
      const Vector3 axis = Vector3::Unit(i), column = log.value * axis;
      rates.col(root.k[i]).setZero(), rates.col(root.k[3 + i]).setZero();
      put_triple(orientation * axis, root.k, rates.col(root.k[i])),
          put_triple(column, root.k + 3, rates.col(root.k[3 + i]));
      put_triple(orientation * axis.cross(translation), root.k, rate_by_q.col(root.k[3 + i]));
      put_triple(log.derivative(column) * rotation_rate, root.k + 3, rate_by_q.col(root.k[3 + i]));
    }
  }
  const Matrix steps = rates.inverse();  // tangent step per change of the coordinates
  jacobian.topLeftCorner(d, d) = rate_by_q * steps;
  jacobian.topRightCorner(d, d) = rates;
  jacobian.bottomLeftCorner(d, d) = Matrix(jacobian.bottomLeftCorner(d, d) * steps);
}

bool Chart::needs_new_reference(In coordinates) const {
  return std::any_of(roots_.begin(), roots_.end(), [&](const Root& root) {
    return triple(coordinates, root.k + 3).norm() > max_rotation_from_reference;
  });
}

}  // namespace ckc
