// The tree: Pinocchio's model and one workspace for it. The only file that sees Pinocchio is tree.cpp.
#pragma once

#include <memory>
#include <string>

#include "tree/types.hpp"

namespace ckc {

// Pinocchio computes into one workspace: what `place` gives is read before the next call, what `bias` gives too.
class Tree {
 public:
  // A model as Pinocchio serializes it in binary, and where the coordinate of each tangent direction stands in q'.
  Tree(const std::string& serialized, Indices place);
  ~Tree();

  int n, nq, joints;
  Indices place;                  // (n)
  struct Root { int q, v; };      // where a free root's seven numbers and its six velocities begin
  std::vector<Root> roots;
  Indices single;                 // tangent coordinates of joints of one freedom
  std::vector<Indices> support;   // by joint: the tangent coordinates that move it, ascending
  std::vector<Indices> ancestors; // by coordinate: those at or above it on its branch, where D' is not zero
  Indices joint_of;               // by coordinate: the joint that it is of
  Indices parent;                 // by joint

  // Other numbers of the model, all joints' one after the other.
  enum class Number { gravity, offset, mass, centre, inertia, armature };
  void vary(Number what, In numbers);

  // How much coarser loops close at q than near zero, at least one: coordinates are rounded as they are large.
  double coarseness(In q, In units) const;

  // Placements of all joints, and the Jacobian in world axes.
  void set(In q);
  const Matrix6x& jacobian() const;
  Matrix3 rotation(int joint) const;
  Vector3 translation(int joint) const;

  // D', upper triangle, with everything that `set` gives.
  void inertia(In q);
  const Matrix& D() const;

  // C'v + h', and the spatial velocities of all joints with what of their accelerations is there at dv/dt = 0.
  const Vector& bias(In q, In v);
  Vector6 velocity(int joint) const;      // world axes, at the world's origin: (linear, angular)
  Vector6 acceleration(int joint) const;  // J_dot v

  const Vector& gravity(In q);               // h'
  const Matrix& coriolis(In q, In v);        // C', Christoffel
  const Matrix6x& jacobian_dot() const;      // after `coriolis`: d/dt of `jacobian`
  const Matrix6x& jacobian_rate(In q, In v); // the same without C'
  double potential_energy(In q);

  // The motion with an acceleration, and how D'a + C'v + h' changes along each coordinate and with each velocity; with
  // `gravity` or without. What follows is that of `set` too, and the motion in the world's axes, at its origin.
  void derivatives(In q, In v, In a, bool gravity, Matrix& by_q, Matrix& by_v);
  Vector6 motion(int joint) const;        // velocity
  Vector6 motion_rate(int joint) const;   // its rate, without gravity
  Matrix6 spatial_inertia(int joint) const;
  Vector6 field() const;                  // gravity
  struct Body { double mass; Vector3 centre; Matrix3 inertia; };
  Body body(int joint) const;             // in the world's axes, its inertia about its centre
  const Vector& armature() const;

  // On q' itself: a free root's place is a position and a unit quaternion, moved by a twist in its axes.
  void normalize(Out q) const;
  void integrate(Out q, In step) const;  // by a tangent step, in place
  void difference(In from, In to, Out step) const;
  void difference_rate(In from, In to, In v, Out rate) const;  // where `to` moves with v
  void configuration_rate(In q, In v, Out q_dot) const;
  Matrix tangents(In q) const;               // (n, nq): tangent steps by changes of q'
  Matrix rate_changes(In q, In v) const;     // (nq, n): of `configuration_rate` by tangent steps
  // What a free root's twist adds to the rate of a tangent step x: x_dot = v_change - brackets(v) x.
  Matrix brackets(In v) const;               // (n, n)
  void add_bracket(In v, In x, Out sum) const;  // brackets(v) x, which is - brackets(x) v
  void to_coordinates(In q, Out numbers) const;  // (n); rotations as rotation vectors
  double coordinate_step(In q, int k, In step) const;  // of one of those, for a step of the tangent coordinates
  Matrix3 orientation(In q, Root root) const;
  // The twist in a free root's axes that takes it to another place.
  Vector6 twist_to(In q, Root root, const Matrix3& orientation, const Vector3& position) const;

 private:
  struct Workspace;
  std::unique_ptr<Workspace> own;
};

// The rotation vector of a rotation, angle at most pi; its inverse; and d log3 along a rotation in its own axes.
Vector3 log3(const Matrix3& rotation);
Matrix3 exp3(const Vector3& vector);
Matrix3 Jlog3(const Matrix3& rotation);

// The version of Pinocchio that this was compiled against.
std::string pinocchio_version();

}  // namespace ckc
