// The articulated-body algorithm: products with D'^-1, and the forces at zero acceleration, in a time proportional to
// the number of joints. D' itself is not computed. Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 7.
//
// The articulated inertias factorize D' = L diag(pivots) L^T: a column of L contains the forces that an acceleration of
// its coordinate causes on those above it. A product with L^-1 is a sweep from the leaves to the roots, a product with
// L^-T one from the roots to the leaves.
#pragma once

#include "tree/rigid_body.hpp"
#include "tree/tree.hpp"

namespace ckc {

class ArticulatedBodies {
 public:
  // Vectors of that many systems of equations at a time; a row for each coordinate.
  static constexpr int block_size = 8;
  template <int size>
  using Block = Eigen::Matrix<double, Eigen::Dynamic, size, size == 1 ? Eigen::ColMajor : Eigen::RowMajor>;

  // A motion or a force, (linear, 0, angular, 0), in world axes at the reference point: the zeros fill vector registers.
  struct alignas(64) Spatial {
    double x[8];
  };
  struct SpatialInertia {
    Spatial column[6];
  };
  struct Coordinate {
    int joint, parent;         // the parent of the joint
    int place, parent_place;   // of these in articulated_ and carried_
    bool is_first, is_last;    // of its joint
    double armature, inertia;  // of all that the coordinate moves: D'(k, k)
    double inverse;            // of the pivot
    Spatial axis, response;    // response: articulated inertia times axis, divided by the pivot
  };
  struct Motion {
    Spatial velocity, acceleration, force;  // force: that this acceleration takes
  };

  explicit ArticulatedBodies(const Tree& tree);

  // Read axes and inertias from the tree, whose placements and Jacobian are those at the configuration.
  void set_configuration(const Tree& tree);
  // C'v + h' without springs.
  const Vector& compute_bias(In v);
  Vector6 velocity(int joint) const { return at_origin(motions_[joint].velocity); }  // as those of Tree
  Vector6 bias_acceleration(int joint) const { return at_origin(motions_[joint].acceleration); }
  // Factorize D'. False if a pivot is so small that digits are lost.
  bool factorize();
  // x <- L^-1 x for forces on the given coordinates, ascending. With a coordinate, all above it are among them.
  template <int size>
  void eliminate(const Indices& coordinates, Block<size>& x);
  // a = L^-T diag(1 / pivots) x
  template <int size>
  void accelerate(const Block<size>& x, Block<size>& a);
  double inertia(int k) const { return coordinates_[k].inertia; }  // D'(k, k); requires `factorize`
  double inverse_pivot(int k) const { return coordinates_[k].inverse; }
  const Indices& all() const { return all_; }  // coordinates

 private:
  Vector6 at_origin(const Spatial& motion) const;

  std::vector<Coordinate> coordinates_;
  std::vector<RigidBody> bodies_, composites_;  // by joint; composites: with all bodies behind the joint, as one
  std::vector<Motion> motions_;                 // by joint, of `compute_bias`
  // By place. A joint and the last one behind it share a place, so that a chain has a single one.
  std::vector<SpatialInertia> articulated_;  // of the bodies behind a joint, of which all joints have been eliminated
  std::vector<Spatial> carried_;             // six rows of forces on these bodies, or of motions
  std::vector<char> is_leaf_;  // by joint
  Indices all_;
  Vector3 gravity_, reference_;
  Vector bias_;
};

}  // namespace ckc
