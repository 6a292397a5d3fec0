#include "loops/chart.hpp"

#include <algorithm>

#include <Eigen/LU>

#include "tree/rotation.hpp"

namespace ckc {

constexpr double far = 1.0;  // rad from the reference: a third of the way to where rotation vectors end

static Vector3 three(In x, const int* at) { return {x(at[0]), x(at[1]), x(at[2])}; }

static void put(const Vector3& three, const int* at, Out x) {
  for (int i = 0; i < 3; ++i) x(at[i]) = three(i);
}

void Chart::start(const Core& core, In q_tree) {
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

void Chart::numbers(const Core& core, In q_tree, Out numbers) const {
  for (int k = 0; k < core.d; ++k) numbers(k) = q_tree(core.tree.place[core.q[k]]);
  for (const Root& root : roots_) {
    put(q_tree.segment<3>(root.at.q), root.k, numbers);
    put(log3(root.reference.transpose() * core.tree.orientation(q_tree, root.at)), root.k + 3, numbers);
  }
}

void Chart::step(const Core& core, In q_tree, In numbers, Out step) const {
  for (int k = 0; k < core.d; ++k) step(k) = numbers(k) - q_tree(core.tree.place[core.q[k]]);
  for (const Root& root : roots_) {
    const Vector6 twist = core.tree.twist_to(q_tree, root.at, root.reference * exp3(three(numbers, root.k + 3)),
                                             three(numbers, root.k));
    put(twist.head<3>(), root.k, step), put(twist.tail<3>(), root.k + 3, step);
  }
}

void Chart::rate(const Core& core, In q_tree, In q_dot, Out rate) const {
  rate = q_dot;
  for (const Root& root : roots_) {
    const Matrix3 turn = core.tree.orientation(q_tree, root.at);
    put(turn * three(q_dot, root.k), root.k, rate);
    put(Jlog3(root.reference.transpose() * turn) * three(q_dot, root.k + 3), root.k + 3, rate);
  }
}

void Chart::jacobian(const Core& core, In q_tree, In q_dot, Matrix& jacobian) const {
  const int d = core.d;
  Matrix rates = Matrix::Identity(d, d), changes = Matrix::Zero(d, d);  // of the numbers by q_dot, and how they change
  for (const Root& root : roots_) {
    const Matrix3 turn = core.tree.orientation(q_tree, root.at);
    const LogRate log(log3(root.reference.transpose() * turn));
    const Vector3 move = three(q_dot, root.k), spin = three(q_dot, root.k + 3);
    for (int i = 0; i < 3; ++i) {
      const Vector3 axis = Vector3::Unit(i), along = log.value * axis;
      rates.col(root.k[i]).setZero(), rates.col(root.k[3 + i]).setZero();
      put(turn * axis, root.k, rates.col(root.k[i])), put(along, root.k + 3, rates.col(root.k[3 + i]));
      put(turn * axis.cross(move), root.k, changes.col(root.k[3 + i]));
      put(log.along(along) * spin, root.k + 3, changes.col(root.k[3 + i]));
    }
  }
  const Matrix steps = rates.inverse();  // by the numbers
  jacobian.topLeftCorner(d, d) = changes * steps;
  jacobian.topRightCorner(d, d) = rates;
  jacobian.bottomLeftCorner(d, d) = Matrix(jacobian.bottomLeftCorner(d, d) * steps);
}

bool Chart::outgrown(In numbers) const {
  return std::any_of(roots_.begin(), roots_.end(),
                     [&](const Root& root) { return three(numbers, root.k + 3).norm() > far; });
}

}  // namespace ckc
