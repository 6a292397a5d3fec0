#include "tree/springs.hpp"

#include <set>

namespace ckc {

Springs::Springs(const Tree& tree, SpringTable spring_table) : table(std::move(spring_table)) {
  const SpringTable& s = table;
  count_ = static_cast<int>(s.stiffness.size());
  update_flags();
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

void Springs::update_flags() {
  const SpringTable& s = table;
  has_elastic_forces = !s.stiffness.isZero(0) || !s.joint_stiffness.isZero(0) || !s.constant.isZero(0);
  has_damping = !s.damping.isZero(0) || !s.joint_damping.isZero(0);
}

void Springs::set_parameters(Parameter parameter, In values) {
  if (parameter == Parameter::end) {
    for (size_t k = 0; k < table.point_local.size(); ++k) table.point_local[k] = values.segment<3>(3 * k);
    return;
  }
  Vector* parts[] = {
      nullptr,           &table.stiffness,     &table.rest_length, &table.damping, &table.joint_stiffness,
      &table.joint_rest, &table.joint_damping, &table.constant};
  *parts[static_cast<int>(parameter)] = values;
  update_flags();
}

void Springs::update_lengths(const Tree& tree) {
  const Matrix6x& columns = tree.jacobian();
  for (int k = 0; k < count_; ++k) {
    Vector3 p[2];
    for (int end : {0, 1}) {
      const int at = end * count_ + k, joint = table.point_joint[at];
      p[end] = tree.rotation(joint) * table.point_local[at] + tree.translation(joint);
    }
    const Vector3 r = p[0] - p[1];
    length_(k) = r.norm();
    // A spring of length zero has no direction and pulls nowhere.
    const Vector3 direction = r / (length_(k) > 0 ? length_(k) : 1.0);
    for (int j : pattern_[k]) jacobian_(k, j) = 0.0;
    for (int end : {0, 1}) {
      Vector6 w;
      w << direction, p[end].cross(direction);
      if (end) w = -w;
      for (int j : tree.support[table.point_joint[end * count_ + k]]) jacobian_(k, j) += w.dot(columns.col(j));
    }
  }
}

void Springs::add_elastic_force(const Tree& tree, In q, Out force) const {
  for (int j = 0; j < tree.n; ++j)
    force(j) += table.constant(j) - table.joint_stiffness(j) * (q(tree.q_index[j]) - table.joint_rest(j));
  for (int k = 0; k < count_; ++k) {
    const double pull = table.stiffness(k) * (length_(k) - table.rest_length(k));
    for (int j : pattern_[k]) force(j) -= pull * jacobian_(k, j);
  }
}

void Springs::add_damping_force(In v, Out force) const {
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
    const double x = q(tree.q_index[j]), elongation = x - table.joint_rest(j);
    energy += 0.5 * table.joint_stiffness(j) * elongation * elongation - table.constant(j) * x;
  }
  for (int k = 0; k < count_; ++k) {
    const double elongation = length_(k) - table.rest_length(k);
    energy += 0.5 * table.stiffness(k) * elongation * elongation;
  }
  return energy;
}

}  // namespace ckc
