#include "tree/articulated_bodies.hpp"

#include <algorithm>
#include <numeric>

#include "tree/rotation.hpp"
#include "tree/widest_registers.hpp"

namespace ckc {

// Pivot, relative to the inertia of all bodies that the coordinate moves. The joints near the root of a long chain have
// small ones. Whether digits are lost that projection keeps is up to EliminationCheck.
constexpr double min_pivot_ratio = 1e-6;

namespace {

using Spatial = ArticulatedBodies::Spatial;
using SpatialInertia = ArticulatedBodies::SpatialInertia;
using Coordinate = ArticulatedBodies::Coordinate;
using Motion = ArticulatedBodies::Motion;

ALWAYS_INLINE Vector8& vector_of(double* x) { return *reinterpret_cast<Vector8*>(x); }
ALWAYS_INLINE const Vector8& vector_of(const double* x) { return *reinterpret_cast<const Vector8*>(x); }

// Template arguments lose the attribute that Vector8 need not be aligned.
typedef double Aligned8 __attribute__((vector_size(8 * sizeof(double))));
ALWAYS_INLINE void read(const double* x, size_t k, double& value) { value = x[k]; }
ALWAYS_INLINE void read(const double* x, size_t k, Aligned8& value) { value = vector_of(x + 8 * k); }
ALWAYS_INLINE void write(const double& value, size_t k, double* x) { x[k] = value; }
ALWAYS_INLINE void write(const Aligned8& value, size_t k, double* x) { vector_of(x + 8 * k) = value; }

constexpr int entry[6] = {0, 1, 2, 4, 5, 6};  // of a Spatial

ALWAYS_INLINE double sum(const double (&terms)[6]) {
  return ((terms[0] + terms[1]) + (terms[2] + terms[3])) + (terms[4] + terms[5]);
}

ALWAYS_INLINE double dot(const Spatial& a, const Spatial& b) {
  double products[6];
  for (int c = 0; c < 6; ++c) products[c] = a.x[entry[c]] * b.x[entry[c]];
  return sum(products);
}

ALWAYS_INLINE Vector3 linear(const Spatial& of) { return {of.x[0], of.x[1], of.x[2]}; }
ALWAYS_INLINE Vector3 angular(const Spatial& of) { return {of.x[4], of.x[5], of.x[6]}; }
ALWAYS_INLINE Spatial spatial(const Vector3& linear, const Vector3& angular) {
  return {{linear.x(), linear.y(), linear.z(), 0.0, angular.x(), angular.y(), angular.z(), 0.0}};
}

// Twice the kinetic energy of a motion.
ALWAYS_INLINE double inertia_along(const RigidBody& body, const Spatial& motion) {
  const Vector3 velocity = linear(motion), omega = angular(motion);
  return velocity.dot(momentum(body, velocity, omega)) + omega.dot(angular_momentum(body, velocity, omega));
}

ALWAYS_INLINE void add(const RigidBody& body, SpatialInertia& sum) {
  const double* const m = body.moment;
  const double(*const i)[4] = body.inertia;
  const Vector8 columns[6] = {{body.mass, 0, 0, 0, 0, m[2], -m[1], 0}, {0, body.mass, 0, 0, -m[2], 0, m[0], 0},
                              {0, 0, body.mass, 0, m[1], -m[0], 0, 0}, {0, -m[2], m[1], 0, i[0][0], i[0][1], i[0][2], 0},
                              {m[2], 0, -m[0], 0, i[1][0], i[1][1], i[1][2], 0},
                              {-m[1], m[0], 0, 0, i[2][0], i[2][1], i[2][2], 0}};
  for (int c = 0; c < 6; ++c) vector_of(sum.column[c].x) += columns[c];
}

WITH_WIDEST_REGISTERS bool factorize_bodies(std::vector<Coordinate>& coordinates, const std::vector<RigidBody>& bodies,
                                            std::vector<RigidBody>& composites, const std::vector<char>& is_leaf,
                                            std::vector<SpatialInertia>& articulated) {
  for (auto at = coordinates.rbegin(); at != coordinates.rend(); ++at) {
    SpatialInertia& inertia = articulated[at->place];
    if (at->is_last) {
      if (is_leaf[at->joint]) inertia = {};
      add(bodies[at->joint], inertia);
    }
    Vector8 product[6];
    for (int c = 0; c < 6; ++c) product[c] = vector_of(inertia.column[c].x) * at->axis.x[entry[c]];
    Spatial force;
    vector_of(force.x) = ((product[0] + product[1]) + (product[2] + product[3])) + (product[4] + product[5]);
    const double pivot = dot(at->axis, force) + at->armature;
    const RigidBody& composite = composites[at->joint];
    at->inertia = inertia_along(composite, at->axis) + at->armature;
    if (!(pivot > min_pivot_ratio * at->inertia)) return false;
    at->inverse = 1.0 / pivot;
    vector_of(at->response.x) = vector_of(force.x) * at->inverse;
    if (at->is_first && !at->parent) continue;
    for (int c = 0; c < 6; ++c) vector_of(inertia.column[c].x) -= vector_of(force.x) * at->response.x[entry[c]];
    if (!at->is_first) continue;
    add(composite, composites[at->parent]);
    if (at->parent_place == at->place) continue;
    SpatialInertia& above = articulated[at->parent_place];
    for (int c = 0; c < 6; ++c) vector_of(above.column[c].x) += vector_of(inertia.column[c].x);
  }
  return true;
}

// Product of a vector with the columns of six rows of numbers, or of eight numbers each.
template <class T>
ALWAYS_INLINE void multiply_rows(const Spatial& vector, const T* rows, T& product) {
  const double* const x = vector.x;
  product = ((rows[0] * x[0] + rows[1] * x[1]) + (rows[2] * x[2] + rows[3] * x[4])) + (rows[4] * x[5] + rows[5] * x[6]);
}

template <class T>
ALWAYS_INLINE void add_rows(const Spatial& vector, const T& factor, T* rows) {
  for (int c = 0; c < 6; ++c) rows[c] += factor * vector.x[entry[c]];
}

template <class T>
ALWAYS_INLINE void sweep_to_roots(const std::vector<Coordinate>& coordinates, const Indices& chosen, T* carried, double* x) {
  for (int k : chosen)
    for (int c = 0; coordinates[k].is_first && c < 6; ++c) carried[6 * coordinates[k].place + c] = T{};
  for (auto i = static_cast<int>(chosen.size()) - 1; i >= 0; --i) {
    const Coordinate& at = coordinates[chosen[i]];
    T* const force = carried + 6 * at.place;
    T load, value;
    multiply_rows(at.axis, force, load), read(x, i, value);
    load = value - load, write(load, i, x);
    if (at.is_first && !at.parent) continue;
    add_rows(at.response, load, force);
    if (!at.is_first || at.parent_place == at.place) continue;
    T* const sum = carried + 6 * at.parent_place;
    for (int c = 0; c < 6; ++c) sum[c] += force[c];
  }
}

template <class T>
ALWAYS_INLINE void sweep_to_leaves(const std::vector<Coordinate>& coordinates, T* carried, const double* x, double* a) {
  for (size_t k = 0; k < coordinates.size(); ++k) {
    const Coordinate& at = coordinates[k];
    T* const motion = carried + 6 * at.place;
    if (at.is_first && !at.parent)
      for (int c = 0; c < 6; ++c) motion[c] = T{};
    else if (at.is_first && at.parent_place != at.place)
      for (int c = 0; c < 6; ++c) motion[c] = carried[6 * at.parent_place + c];
    T load, value;
    multiply_rows(at.response, motion, load), read(x, k, value);
    const T acceleration = value * at.inverse - load;
    write(acceleration, k, a);
    add_rows(at.axis, acceleration, motion);
  }
}

constexpr int block_size = ArticulatedBodies::block_size;

WITH_WIDEST_REGISTERS void eliminate_block(const std::vector<Coordinate>& coordinates, const Indices& chosen,
                                           double* carried, double* x) {
  sweep_to_roots(coordinates, chosen, reinterpret_cast<Aligned8*>(carried), x);
}

WITH_WIDEST_REGISTERS void accelerate_block(const std::vector<Coordinate>& coordinates, double* carried,
                                            const double* x, double* a) {
  sweep_to_leaves(coordinates, reinterpret_cast<Aligned8*>(carried), x, a);
}

}  // namespace

ArticulatedBodies::ArticulatedBodies(const Tree& tree)
    : coordinates_(tree.n), bodies_(tree.joints), composites_(tree.joints), motions_(tree.joints),
      is_leaf_(tree.joints, 1), all_(tree.n), gravity_(Vector3::Zero()), reference_(Vector3::Zero()),
      bias_(Vector::Zero(tree.n)) {
  std::iota(all_.begin(), all_.end(), 0);
  for (int k = 0; k < tree.n; ++k) {
    Coordinate& at = coordinates_[k];
    at.joint = tree.joint_of[k], at.parent = tree.parent[at.joint];
    at.is_first = !k || tree.joint_of[k - 1] != at.joint;
    at.is_last = k + 1 == tree.n || tree.joint_of[k + 1] != at.joint;
  }
  Indices place(tree.joints, -1);
  int places = 0;
  for (int joint = tree.joints - 1; joint > 0; --joint) {
    if (place[joint] < 0) place[joint] = places++;
    const int above = tree.parent[joint];
    if (place[above] < 0) place[above] = place[joint];
    is_leaf_[above] = 0;
  }
  for (Coordinate& at : coordinates_) at.place = place[at.joint], at.parent_place = place[at.parent];
  articulated_.resize(places), carried_.resize(static_cast<size_t>(6) * places);
}

// The reference point is on the mechanism: far from it, sums of moments lose digits.
void ArticulatedBodies::set_configuration(const Tree& tree) {
  gravity_ = tree.spatial_gravity().head<3>(), reference_ = tree.translation(tree.joints > 1 ? 1 : 0);
  const Matrix6x& jacobian = tree.jacobian();
  const Vector& armature = tree.armature();
  for (size_t k = 0; k < coordinates_.size(); ++k) {
    Coordinate& at = coordinates_[k];
    const auto column = jacobian.col(static_cast<Eigen::Index>(k));
    const double x = column(3), y = column(4), z = column(5);
    at.axis = {{column(0) + y * reference_.z() - z * reference_.y(), column(1) + z * reference_.x() - x * reference_.z(),
                column(2) + x * reference_.y() - y * reference_.x(), 0.0, x, y, z, 0.0}};
    at.armature = armature(static_cast<Eigen::Index>(k));
  }
  for (size_t joint = 1; joint < bodies_.size(); ++joint) {
    const Tree::Body in_world = tree.body(static_cast<int>(joint));
    bodies_[joint] = rigid_body(in_world.mass, in_world.centre - reference_, in_world.inertia);
  }
}

const Vector& ArticulatedBodies::compute_bias(In v) {
  motions_[0].velocity = motions_[0].acceleration = {};
  for (size_t k = 0; k < coordinates_.size();) {
    const int joint = coordinates_[k].joint;
    const RigidBody& body = bodies_[joint];
    Motion& motion = motions_[joint];
    const Motion& above = motions_[coordinates_[k].parent];
    Vector3 relative = Vector3::Zero(), omega_relative = Vector3::Zero();
    do {
      const double rate = v(static_cast<Eigen::Index>(k));
      relative += rate * linear(coordinates_[k].axis), omega_relative += rate * angular(coordinates_[k].axis);
    } while (++k < coordinates_.size() && coordinates_[k].joint == joint);
    const Vector3 velocity = linear(above.velocity) + relative, omega = angular(above.velocity) + omega_relative;
    const Vector3 rate = linear(above.acceleration) + omega.cross(relative) + velocity.cross(omega_relative);
    const Vector3 omega_rate = angular(above.acceleration) + omega.cross(omega_relative), lifted = rate - gravity_;
    const Vector3 p = momentum(body, velocity, omega), l = angular_momentum(body, velocity, omega);
    motion.velocity = spatial(velocity, omega), motion.acceleration = spatial(rate, omega_rate);
    motion.force = spatial(momentum(body, lifted, omega_rate) + omega.cross(p),
                         angular_momentum(body, lifted, omega_rate) + omega.cross(l) + velocity.cross(p));
  }
  for (auto k = static_cast<Eigen::Index>(coordinates_.size()) - 1; k >= 0; --k) {
    const Coordinate& at = coordinates_[static_cast<size_t>(k)];
    const Spatial& force = motions_[at.joint].force;
    bias_(k) = dot(at.axis, force);
    if (!at.is_first) continue;
    for (int i = 0; i < 8; ++i) motions_[at.parent].force.x[i] += force.x[i];
  }
  return bias_;
}

Vector6 ArticulatedBodies::at_origin(const Spatial& motion) const {
  Vector6 at;
  at << linear(motion) - angular(motion).cross(reference_), angular(motion);
  return at;
}

bool ArticulatedBodies::factorize() {
  composites_ = bodies_;
  return factorize_bodies(coordinates_, bodies_, composites_, is_leaf_, articulated_);
}

template <int size>
void ArticulatedBodies::eliminate(const Indices& coordinates, Block<size>& x) {
  if constexpr (size == 1)
    sweep_to_roots(coordinates_, coordinates, carried_.data()->x, x.data());
  else
    eliminate_block(coordinates_, coordinates, carried_.data()->x, x.data());
}

template <int size>
void ArticulatedBodies::accelerate(const Block<size>& x, Block<size>& a) {
  if constexpr (size == 1)
    sweep_to_leaves(coordinates_, carried_.data()->x, x.data(), a.data());
  else
    accelerate_block(coordinates_, carried_.data()->x, x.data(), a.data());
}

template void ArticulatedBodies::eliminate<1>(const Indices&, Block<1>&);
template void ArticulatedBodies::eliminate<block_size>(const Indices&, Block<block_size>&);
template void ArticulatedBodies::accelerate<1>(const Block<1>&, Block<1>&);
template void ArticulatedBodies::accelerate<block_size>(const Block<block_size>&, Block<block_size>&);

}  // namespace ckc
