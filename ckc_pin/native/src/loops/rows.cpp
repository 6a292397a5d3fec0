#include "loops/rows.hpp"
#include "tree/large_pages.hpp"

#include <algorithm>
#include <cmath>
#include <set>

namespace ckc {

namespace {

// Wrench of a force at a point.
Vector6 force(const Vector3& at, const Vector3& direction) {
  Vector6 w;
  w << direction, at.cross(direction);
  return w;
}

// Rate of `force`.
Vector6 force_rate(const Vector3& at, const Vector3& direction, const Vector3& at_dot, const Vector3& direction_dot) {
  Vector6 w;
  w << direction_dot, at_dot.cross(direction) + at.cross(direction_dot);
  return w;
}

Vector6 torque(const Vector3& about) {
  Vector6 w;
  w << Vector3::Zero(), about;
  return w;
}

}  // namespace

Vector4 Curve::evaluate(double x) const {
  const auto piece = std::upper_bound(breaks.begin(), breaks.end(), x) - breaks.begin();
  x -= origins(piece);
  Vector4 taylor = Vector4::Zero();
  for (auto k = coefficients.rows() - 1; k >= 0; --k) {
    for (int i = 3; i > 0; --i) taylor(i) = taylor(i) * x + taylor(i - 1);
    taylor(0) = taylor(0) * x + coefficients(k, piece);
  }
  return taylor.cwiseProduct(Vector4(1.0, 1.0, 2.0, 6.0));
}

ConstraintRows::ConstraintRows(const Tree& tree, Closure table) : closure(std::move(table)) {
  const Closure& c = closure;
  pair_count_ = static_cast<int>(c.point_joint.size()) / 2;
  p_.resize(2 * pair_count_), p_dot_.resize(2 * pair_count_), r_.resize(pair_count_), r_dot_.resize(pair_count_);
  e_.resize(c.direction_joint.size()), e_dot_.resize(c.direction_joint.size());
  velocity_.resize(tree.joints, Vector6::Zero()), acceleration_.resize(tree.joints, Vector6::Zero());
  wrenches_.resize(c.rows), pattern.resize(c.rows);
  log_jacobians_.assign(c.logs.size(), LogJacobian(Vector3::Zero()));
  // The first two wrenches of a row are those of its points or directions. Beyond them, the world needs none.
  std::vector<Indices> joints_of_row(c.rows);
  const auto joints = [&](int out, std::initializer_list<int> list) {
    joints_of_row[out] = list;
    for (int joint : list)
      if (joint || wrenches_[out].size() < 2)
        wrenches_[out].push_back({joint, {}, {}, Vector6::Zero(), Vector6::Zero()});
  };
  for (const auto& row : c.components)
    joints(row.out, {c.point_joint[row.pair], c.point_joint[pair_count_ + row.pair], c.direction_joint[row.direction]});
  for (const auto& row : c.dots) joints(row.out, {c.direction_joint[row.a], c.direction_joint[row.b]});
  for (const auto& row : c.distances) joints(row.out, {c.point_joint[row.pair], c.point_joint[pair_count_ + row.pair]});
  for (const auto& rows : c.logs)
    for (int out : rows.out) joints(out, {rows.joint_a, rows.joint_b});
  std::set<int> used(c.point_joint.begin(), c.point_joint.end());
  used.insert(c.direction_joint.begin(), c.direction_joint.end());
  for (const auto& rows : c.logs) used.insert(rows.joint_a), used.insert(rows.joint_b);
  used.erase(0);  // the world does not move
  joints_.assign(used.begin(), used.end());
  phi.setZero(c.rows), set_zero(J_, c.rows, tree.n), set_zero(J_dot, c.rows, tree.n);
  curve_values_.assign(c.curves.size(), Vector4::Zero()), curve_rates_.setZero(c.curves.size());
  for (const auto& row : c.affine) J_.row(row.out) = row.coefficients;
  places_in_column_.resize(tree.n);
  for (int i = 0; i < c.rows; ++i) {
    std::set<int> columns;
    for (Wrench& wrench : wrenches_[i]) {
      for (int j : tree.support[wrench.joint]) {
        const auto is_moved = [&](int joint) {
          return std::binary_search(tree.support[joint].begin(), tree.support[joint].end(), j);
        };
        if (!std::all_of(joints_of_row[i].begin(), joints_of_row[i].end(), is_moved)) wrench.coordinates.push_back(j);
      }
      columns.insert(wrench.coordinates.begin(), wrench.coordinates.end());
    }
    for (int j = 0; j < tree.n; ++j)
      if (J_(i, j) != 0.0) columns.insert(j);
    for (const auto& curve : c.curves)
      if (curve.out == i) columns.insert(curve.coordinate);
    pattern[i].assign(columns.begin(), columns.end());
    for (Wrench& wrench : wrenches_[i])
      for (int j : wrench.coordinates) {
        const auto place = std::lower_bound(pattern[i].begin(), pattern[i].end(), j);
        wrench.places.push_back(static_cast<int>(place - pattern[i].begin()));
      }
    for (int j : pattern[i]) {
      places_in_column_[j].emplace_back(i, static_cast<int>(J_entries_.size()));
      J_entries_.push_back(J_(i, j));
    }
  }
}

void ConstraintRows::set_parameters(Parameter parameter, In values) {
  if (parameter == Parameter::point)
    for (size_t k = 0; k < closure.point_local.size(); ++k) closure.point_local[k] = values.segment<3>(3 * k);
  if (parameter == Parameter::length)
    for (auto& row : closure.distances) row.length = values(row.out);
  const auto n = J_.cols();
  for (auto& row : closure.affine) {
    if (parameter == Parameter::affine) {
      row.coefficients = values.segment(n * row.out, n), J_.row(row.out) = row.coefficients;
      for (int j : pattern[row.out]) entry(row.out, j) = row.coefficients(j);
    }
    if (parameter == Parameter::affine_offset) row.offset = values(row.out);
  }
}

void ConstraintRows::update(const Tree& tree, In q) {
  const Closure& c = closure;
  for (size_t k = 0; k < p_.size(); ++k)
    p_[k] = tree.rotation(c.point_joint[k]) * c.point_local[k] + tree.translation(c.point_joint[k]);
  for (int k = 0; k < pair_count_; ++k) r_[k] = p_[k] - p_[pair_count_ + k];
  for (size_t k = 0; k < e_.size(); ++k) e_[k] = tree.rotation(c.direction_joint[k]) * c.direction_local[k];
  for (const auto& row : c.components) {
    const Vector3 &e = e_[row.direction], &r = r_[row.pair];
    auto& w = wrenches_[row.out];
    phi(row.out) = e.dot(r);
    w[0].w = force(p_[row.pair], e);
    w[1].w = -force(p_[pair_count_ + row.pair], e);
    if (w.size() > 2) w[2].w = torque(e.cross(r));  // e_dot . r = (omega x e) . r = omega . (e x r)
  }
  for (const auto& row : c.dots) {
    auto& w = wrenches_[row.out];
    phi(row.out) = e_[row.a].dot(e_[row.b]);
    w[0].w = torque(e_[row.a].cross(e_[row.b]));
    w[1].w = -w[0].w;
  }
  for (const auto& row : c.distances) {
    const Vector3 direction = r_[row.pair] / row.length;
    auto& w = wrenches_[row.out];
    phi(row.out) = (r_[row.pair].squaredNorm() - row.length * row.length) / (2 * row.length);
    w[0].w = force(p_[row.pair], direction);
    w[1].w = -force(p_[pair_count_ + row.pair], direction);
  }
  for (const auto& row : c.affine) {
    double value = -row.offset;
    for (int j : pattern[row.out]) value += row.coefficients(j) * q(tree.q_index[j]);
    phi(row.out) = value;
  }
  for (size_t k = 0; k < c.curves.size(); ++k) {
    const Curve& curve = c.curves[k];
    curve_values_[k] = curve.evaluate(q(tree.q_index[curve.coordinate]));
    phi(curve.out) -= curve_values_[k](0);
  }
  update_relative_rotations(tree);
}

void ConstraintRows::update_relative_rotations(const Tree& tree) {
  for (size_t log = 0; log < closure.logs.size(); ++log) {
    const auto& rows = closure.logs[log];
    const Matrix3 r_a = tree.rotation(rows.joint_a) * rows.rotation_a;
    const Matrix3 r_b = tree.rotation(rows.joint_b) * rows.rotation_b;
    const Vector3 u = log3(r_a.transpose() * r_b);
    log_jacobians_[log] = LogJacobian(u);
    const Matrix3 m = log_jacobians_[log].value * r_b.transpose();
    for (int k = 0; k < 3; ++k) {
      auto& w = wrenches_[rows.out[k]];
      phi(rows.out[k]) = u(k);
      w[1].w = torque(m.row(k));
      w[0].w = -w[1].w;
    }
  }
}

void ConstraintRows::update_rates(const Tree& tree, In v) {
  const Closure& c = closure;
  for (size_t k = 0; k < c.curves.size(); ++k) curve_rates_(static_cast<Eigen::Index>(k)) = v(c.curves[k].coordinate);
  for (size_t k = 0; k < p_.size(); ++k) {
    const Vector6& v = velocity_[c.point_joint[k]];
    p_dot_[k] = v.head<3>() + Vector3(v.tail<3>()).cross(p_[k]);
  }
  for (int k = 0; k < pair_count_; ++k) r_dot_[k] = p_dot_[k] - p_dot_[pair_count_ + k];
  for (size_t k = 0; k < e_.size(); ++k) e_dot_[k] = Vector3(velocity_[c.direction_joint[k]].tail<3>()).cross(e_[k]);
  for (const auto& row : c.components) {
    const int a = row.pair, b = pair_count_ + row.pair;
    const Vector3 &e = e_[row.direction], &e_dot = e_dot_[row.direction];
    auto& w = wrenches_[row.out];
    w[0].w_dot = force_rate(p_[a], e, p_dot_[a], e_dot);
    w[1].w_dot = -force_rate(p_[b], e, p_dot_[b], e_dot);
    if (w.size() > 2) w[2].w_dot = torque(e_dot.cross(r_[row.pair]) + e.cross(r_dot_[row.pair]));
  }
  for (const auto& row : c.dots) {
    auto& w = wrenches_[row.out];
    w[0].w_dot = torque(e_dot_[row.a].cross(e_[row.b]) + e_[row.a].cross(e_dot_[row.b]));
    w[1].w_dot = -w[0].w_dot;
  }
  for (const auto& row : c.distances) {
    const int a = row.pair, b = pair_count_ + row.pair;
    const Vector3 direction = r_[row.pair] / row.length, direction_dot = r_dot_[row.pair] / row.length;
    auto& w = wrenches_[row.out];
    w[0].w_dot = force_rate(p_[a], direction, p_dot_[a], direction_dot);
    w[1].w_dot = -force_rate(p_[b], direction, p_dot_[b], direction_dot);
  }
  update_relative_rotation_rates(tree);
}

void ConstraintRows::update_relative_rotation_rates(const Tree& tree) {
  for (size_t log = 0; log < closure.logs.size(); ++log) {
    const auto& rows = closure.logs[log];
    const LogJacobian& j_log = log_jacobians_[log];
    const Matrix3 r_b = tree.rotation(rows.joint_b) * rows.rotation_b;
    const Vector3 omega_b = velocity_[rows.joint_b].tail<3>();
    const Vector3 omega = omega_b - velocity_[rows.joint_a].tail<3>();
    const Vector3 u_dot = j_log.value * (r_b.transpose() * omega);
    // d/dt (R_B^T X) = R_B^T (X_dot - omega_B x X)
    const Matrix3 m_dot = j_log.derivative(u_dot) * r_b.transpose() - j_log.value * r_b.transpose() * skew(omega_b);
    for (int k = 0; k < 3; ++k) {
      auto& w = wrenches_[rows.out[k]];
      w[1].w_dot = torque(m_dot.row(k));
      w[0].w_dot = -w[1].w_dot;
    }
  }
}

void ConstraintRows::update_jacobian(const Tree& tree) {
  const Matrix6x& columns = tree.jacobian();
  double* entries = J_entries_.data();
  for (int i = 0; i < closure.rows; entries += pattern[i++].size()) {
    if (wrenches_[i].empty()) continue;  // the Jacobian of an affine row is constant, except for its curve
    std::fill_n(entries, pattern[i].size(), 0.0);
    for (const auto& wrench : wrenches_[i])
      for (size_t k = 0; k < wrench.coordinates.size(); ++k)
        entries[wrench.places[k]] += wrench.w.dot(columns.col(wrench.coordinates[k]));
  }
  for (size_t k = 0; k < closure.curves.size(); ++k)
    entry(closure.curves[k].out, closure.curves[k].coordinate) = -curve_values_[k](1);
  J_entries_are_set_ = true, J_is_set_ = false;
}

// Of J_entries_.
double& ConstraintRows::entry(int i, int j) {
  const auto& places = places_in_column_[j];
  const auto at = std::lower_bound(places.begin(), places.end(), std::pair<int, int>(i, 0));
  return J_entries_[static_cast<size_t>(at->second)];
}

const std::vector<double>& ConstraintRows::J_entries() {
  if (!J_entries_are_set_) {
    double* entry = J_entries_.data();
    for (int i = 0; i < closure.rows; ++i)
      for (int j : pattern[i]) *entry++ = J_(i, j);
    J_entries_are_set_ = true;
  }
  return J_entries_;
}

const Matrix& ConstraintRows::J() {
  if (!J_is_set_) {
    const double* entry = J_entries_.data();
    for (int i = 0; i < closure.rows; ++i)
      for (int j : pattern[i]) J_(i, j) = *entry++;
    J_is_set_ = true;
  }
  return J_;
}

Matrix& ConstraintRows::J_to_set() { return J_is_set_ = true, J_entries_are_set_ = false, J_; }

void ConstraintRows::J_column(int j, Out column) {
  const std::vector<double>& entries = J_entries();
  column.setZero();
  for (const auto& [row, place] : places_in_column_[j]) column(row) = entries[static_cast<size_t>(place)];
}

void ConstraintRows::update_jacobian_dot(const Tree& tree, const Matrix6x& columns_dot) {
  const Matrix6x& columns = tree.jacobian();
  for (int i = 0; i < closure.rows; ++i) {
    for (int j : pattern[i]) J_dot(i, j) = 0.0;
    for (const auto& wrench : wrenches_[i])
      for (int j : wrench.coordinates)
        J_dot(i, j) += wrench.w.dot(columns_dot.col(j)) + wrench.w_dot.dot(columns.col(j));
  }
  for (size_t k = 0; k < closure.curves.size(); ++k)
    J_dot(closure.curves[k].out, closure.curves[k].coordinate) =
        -curve_values_[k](2) * curve_rates_(static_cast<Eigen::Index>(k));
}

void ConstraintRows::bias(Out J_dot_v) const {
  for (int i = 0; i < closure.rows; ++i) {
    double value = 0.0;
    for (const auto& wrench : wrenches_[i])
      if (wrench.joint) value += wrench.w.dot(acceleration_[wrench.joint]) + wrench.w_dot.dot(velocity_[wrench.joint]);
    J_dot_v(i) = value;
  }
  for (size_t k = 0; k < closure.curves.size(); ++k) {
    const double rate = curve_rates_(static_cast<Eigen::Index>(k));
    J_dot_v(closure.curves[k].out) -= curve_values_[k](2) * rate * rate;
  }
}

void ConstraintRows::multiply_J(In v, Out product) {
  const double* entry = J_entries().data();
  for (int i = 0; i < closure.rows; ++i) {
    double sum = 0.0;
    for (int j : pattern[i]) sum += *entry++ * v(j);
    product(i) = sum;
  }
}

double ConstraintRows::J_norm() {
  double square = 0.0;
  for (double entry : J_entries()) square += entry * entry;
  return std::sqrt(square);
}

ConstraintRows::Columns ConstraintRows::in_columns(const Indices& columns) const {
  Indices at(places_in_column_.size(), -1);
  for (size_t j = 0; j < columns.size(); ++j) at[columns[j]] = static_cast<int>(j);
  Columns part{std::vector<Indices>(pattern.size()), std::vector<Indices>(pattern.size())};
  int place = 0;
  for (size_t i = 0; i < pattern.size(); ++i)
    for (int j : pattern[i]) {
      if (at[j] >= 0) part.pattern[i].push_back(at[j]), part.places[i].push_back(place);
      ++place;
    }
  return part;
}

}  // namespace ckc
