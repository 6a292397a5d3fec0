#include "tree/springs.hpp"

#include <set>

namespace ckc {

Springs::Springs(const Tree& tree, SpringTable given) : table(std::move(given)) {
  const SpringTable& s = table;
  count_ = static_cast<int>(s.stiffness.size());
  look();
  length_.setZero(count_), jacobian_.setZero(count_, tree.n), pattern_.resize(count_);
  for (int k = 0; k < count_; ++k) {
    std::set<int> columns;
    for (int end : {k, count_ + k}) {
      const auto& support = tree.support[s.point_joint[end]];
      columns.insert(support.begin(), support.end());
    }
    pattern_[k].assign(columns.begin(), columns.end());
  }
}

void Springs::look() {
  const SpringTable& s = table;
  any = !s.stiffness.isZero(0) || !s.joint_stiffness.isZero(0) || !s.constant.isZero(0);
  any_damping = !s.damping.isZero(0) || !s.joint_damping.isZero(0);
}

void Springs::vary(Number what, In numbers) {
  if (what == Number::end) {
    for (size_t k = 0; k < table.point_local.size(); ++k) table.point_local[k] = numbers.segment<3>(3 * k);
    return;
  }
  Vector* parts[] = {nullptr, &table.stiffness, &table.rest_length, &table.damping,
                     &table.joint_stiffness, &table.joint_rest, &table.joint_damping, &table.constant};
  *parts[static_cast<int>(what)] = numbers;
  look();
}

void Springs::set(const Tree& tree) {
  const Matrix6x& columns = tree.jacobian();
  for (int k = 0; k < count_; ++k) {
    Vector3 p[2];
    for (int end : {0, 1}) {
      const int at = end * count_ + k, joint = table.point_joint[at];
      p[end] = tree.rotation(joint) * table.point_local[at] + tree.translation(joint);
    }
    const Vector3 r = p[0] - p[1];
    length_(k) = r.norm();
    const Vector3 along = r / (length_(k) > 0 ? length_(k) : 1.0);  // at length zero it pulls nowhere
    for (int j : pattern_[k]) jacobian_(k, j) = 0.0;
    for (int end : {0, 1}) {
      Vector6 w;
      w << along, p[end].cross(along);
      if (end) w = -w;
      for (int j : tree.support[table.point_joint[end * count_ + k]]) jacobian_(k, j) += w.dot(columns.col(j));
    }
  }
}

void Springs::add_elastic(const Tree& tree, In q, Out force) const {
  for (int j = 0; j < tree.n; ++j)
    force(j) += table.constant(j) - table.joint_stiffness(j) * (q(tree.place[j]) - table.joint_rest(j));
  for (int k = 0; k < count_; ++k) {
    const double pull = table.stiffness(k) * (length_(k) - table.rest_length(k));
    for (int j : pattern_[k]) force(j) -= pull * jacobian_(k, j);
  }
}

void Springs::add_damping(In v, Out force) const {
  force.array() -= table.joint_damping.array() * v.array();
  for (int k = 0; k < count_; ++k) {
    if (table.damping(k) == 0.0) continue;
    double rate = 0.0;
    for (int j : pattern_[k]) rate += jacobian_(k, j) * v(j);
    for (int j : pattern_[k]) force(j) -= table.damping(k) * rate * jacobian_(k, j);
  }
}

double Springs::energy(const Tree& tree, In q) const {
  double energy = 0.0;
  for (int j = 0; j < tree.n; ++j) {
    const double x = q(tree.place[j]), stretched = x - table.joint_rest(j);
    energy += 0.5 * table.joint_stiffness(j) * stretched * stretched - table.constant(j) * x;
  }
  for (int k = 0; k < count_; ++k) {
    const double stretched = length_(k) - table.rest_length(k);
    energy += 0.5 * table.stiffness(k) * stretched * stretched;
  }
  return energy;
}

}  // namespace ckc
