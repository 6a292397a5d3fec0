// The kinematic tree: Pinocchio's model and data. tree.cpp is the only file that includes Pinocchio.
#pragma once

#include <memory>
#include <string>

#include "tree/types.hpp"

namespace ckc {

// A kinematic tree and one workspace for its terms. References that a method returns are valid until the next call.
class Tree {
 public:
  // `serialized`: a model in Pinocchio's binary format. `q_index`: for each tangent coordinate, its index in q'.
  Tree(const std::string& serialized, Indices q_index);
  ~Tree();

  int n, nq, joints;
  Indices q_index;  // (n)
  // A free root: index of its first coordinate in q' (seven: position, quaternion) and in v' (six: twist).
  struct Root {
    int q, v;
  };
  std::vector<Root> roots;
  Indices single_dof;              // tangent coordinates of joints with one degree of freedom
  std::vector<Indices> support;    // by joint: the tangent coordinates that move it, ascending
  std::vector<Indices> ancestors;  // by coordinate: those at or above it on its branch
  // By coordinate j: the rows i <= j where D' may be different from zero. These are the ancestors, and coordinates that
  // share a rotor with j.
  std::vector<Indices> inertia_pattern;
  Indices D_diagonal;              // by coordinate: place of its entry on the diagonal among `D_entries`
  Indices joint_of;                // by coordinate: its joint
  Indices parent;                  // by joint

  // Replace one kind of parameter for all joints; `values`: concatenated by joint (gravity: three, armature: n, rotors: the
  // upper triangle, row by row in (n, n), of the matrix that rotors of motors on several joints add to D').
  enum class Parameter { gravity, offset, mass, centre, inertia, armature, rotors };
  void set_parameters(Parameter parameter, In values);

  // Factor (at least one) by which closure tolerances grow at q: large coordinates carry larger rounding errors.
  double tolerance_scale(In q, In units) const;
  // The same from the largest coordinate of q, in its unit.
  static double tolerance_factor(double largest_coordinate);

  // Compute the placements of all joints and the Jacobian, in world axes.
  void set_configuration(In q);
  const Matrix6x& jacobian() const;
  Matrix3 rotation(int joint) const;
  Vector3 translation(int joint) const;

  // Compute the entries of D' in the order of `inertia_pattern`, and everything that `set_configuration` computes.
  void compute_D(In q);
  const std::vector<double>& D_entries() const;

  // Compute C'v + h', the spatial velocities, and the accelerations at dv/dt = 0.
  const Vector& compute_bias(In q, In v);
  Vector6 velocity(int joint) const;           // (linear, angular) in world axes, at the world's origin
  Vector6 bias_acceleration(int joint) const;  // J_dot v; requires `compute_bias`

  const Vector& compute_gravity(In q);               // h'
  const Matrix& compute_coriolis(In q, In v);        // C' with Christoffel symbols
  const Matrix6x& jacobian_dot() const;              // d/dt of `jacobian`; requires `compute_coriolis`
  const Matrix6x& compute_jacobian_dot(In q, In v);  // the same, without computing C'
  double potential_energy(In q);

  // Compute the derivatives of D'a + C'v + h' (h' only if `gravity`) with respect to q' (tangent) and v'. Afterwards,
  // placements, the Jacobian, `velocity` and `acceleration` are those at this state.
  void compute_derivatives(In q, In v, In a, bool gravity, Matrix& by_q, Matrix& by_v);
  Vector6 acceleration(int joint) const;  // without gravity; requires `compute_derivatives`
  Matrix6 spatial_inertia(int joint) const;
  Vector6 spatial_gravity() const;  // (linear, angular), m/s^2
  struct Body {
    double mass;
    Vector3 centre;
    Matrix3 inertia;
  };
  Body body(int joint) const;  // in world axes, the inertia about the centre of mass
  // Constant part of D' (n, n): armatures, and rotors of motors on several joints.
  Matrix rotor_inertia() const;
  const Vector& armature() const;  // (n)
  bool has_shared_rotors() const { return rotors_.size() > 0; }

  // Operations on q'. A free root has a position and a unit quaternion, and moves by a twist in its own axes.
  void normalize(Out q) const;
  void integrate(Out q, In step) const;  // q <- q + step, in tangent coordinates
  void difference(In from, In to, Out step) const;
  void difference_rate(In from, In to, In v, Out rate) const;  // d/dt of `difference` where `to` moves with v
  void configuration_rate(In q, In v, Out q_dot) const;
  Matrix q_dot_to_tangent(In q) const;  // (n, nq): maps a small step of q' to a tangent step
  // (nq, n): derivative of `configuration_rate` with respect to tangent steps
  Matrix configuration_rate_derivative(In q, In v) const;
  // The rate of a tangent step x along a motion v: x_dot = delta_v - bracket_matrix(v) x. Zero without free roots.
  Matrix bracket_matrix(In v) const;                     // (n, n)
  void add_bracket(In v, In x, Out sum) const;           // sum += bracket_matrix(v) x
  void to_coordinates(In q, Out coordinates) const;      // (n); rotations as rotation vectors
  double coordinate_change(In q, int k, In step) const;  // of the k-th of these coordinates, for a tangent step
  Matrix3 orientation(In q, Root root) const;
  // Twist, in the free root's axes, that moves it to another placement.
  Vector6 twist_to(In q, Root root, const Matrix3& orientation, const Vector3& position) const;

 private:
  void set_rotors(In values);
  void set_inertia_pattern(std::vector<Indices> pattern);

  Matrix rotors_;  // (n, n); empty without motors on several joints that have a rotor
  struct Workspace;
  std::unique_ptr<Workspace> workspace_;
};

// Rotation vector of a rotation (angle at most pi), the inverse map, and the Jacobian of log3.
Vector3 log3(const Matrix3& rotation);
Matrix3 exp3(const Vector3& vector);
Matrix3 Jlog3(const Matrix3& rotation);

// Version of Pinocchio that the core was compiled against.
std::string pinocchio_version();

}  // namespace ckc
