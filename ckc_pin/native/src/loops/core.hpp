// The terms of a mechanism at one state, each computed when it is first needed, and accelerations computed from them.
//
// All results are stored in the object and overwritten by the next state. Nothing is allocated after construction,
// except when the tangent basis changes its partition and near a loss of rank.
#pragma once

#include <Eigen/QR>

#include "loops/derivatives.hpp"
#include "loops/joints.hpp"
#include "tree/linear.hpp"
#include "loops/rows.hpp"
#include "tree/springs.hpp"
#include "loops/profile.hpp"

namespace ckc {

class ArticulatedBodies;
class ArticulatedElimination;
class CompiledTerms;
class SparseElimination;

struct Energy {
  double kinetic, potential;  // J; potential: of gravity, springs and constant forces
  double total() const { return kinetic + potential; }
};

// Values that rows follow: phi = residual - value. Zero for rows that close loops.
struct RowMotion {
  Vector value, rate;  // (rows)
};

struct Scales {
  Vector rows, columns;  // factors that make J dimensionless
  double rank;           // relative size below which a pivot of the scaled J counts as zero
};

// The data of which a Core is built.
struct CoreTable {
  std::string model;  // in Pinocchio's binary format
  Indices q_index;    // for each tangent coordinate, its index in q'
  Closure closure;
  SpringTable springs;
  JointTable joints;
  Vector rotors;  // (n * n), as Tree::Parameter::rotors; empty without motors on several joints that have a rotor
  int rank;  // of J at a regular configuration
  Indices independent_rows;
  Scales scales;
  std::unique_ptr<CompiledTerms> compiled;  // null: Pinocchio's terms
};

// A force on the tree that may depend on the state, and its derivatives with respect to q' (tangent) and v'. Empty
// derivatives are zero.
struct AppliedForce {
  Vector value;       // (n)
  Matrix by_q, by_v;  // (n, n)
};

// An acceleration of the tree and its derivatives with respect to q' (tangent), v' and u'.
struct AccelerationDerivatives {
  Vector a;                 // (n)
  Matrix by_q, by_v, by_u;  // (n, n)
};

class Core {
 public:
  explicit Core(CoreTable table);
  ~Core();

  void set_partition(Indices q, Indices z);  // partition q' = [q; z]

  // Kinds of parameters, in the order of Tree::Parameter, ConstraintRows::Parameter and Springs::Parameter. `compiled`:
  // all parameters of the compiled terms, as `ckc_pin.codegen.arguments` lists them.
  enum class Parameter {
    gravity,
    offset,
    mass,
    centre,
    inertia,
    armature,
    rotors,
    point,
    length,
    affine,
    affine_offset,
    end,
    stiffness,
    rest_length,
    damping,
    joint_stiffness,
    joint_rest,
    joint_damping,
    constant,
    compiled,
  };
  Eigen::Index parameter_size(Parameter parameter) const;
  // Replace one kind of parameter. All computed terms become invalid.
  void set_parameters(Parameter parameter, In values);
  // Whether det phi_z < 0 at this configuration; false if phi_z is not square.
  bool has_negative_determinant();

  Tree tree;
  ConstraintRows constraints;
  Springs springs;
  Joints joints;
  const int n, rank;
  const Scales scales;
  int d;
  Indices q, z;
  Profile profile;
  std::unique_ptr<CompiledTerms> compiled;  // terms of the tree and the constraint rows; null: Pinocchio's

  // --- terms that depend on q' ---
  // Compute phi and the placements. `with_inertia`: also D', in the same sweep through the tree.
  void set_configuration(In q_tree, bool with_inertia = false);
  // Prescribed motion of rows at the present time. `set_configuration` uses its value. Empty if all rows are constant.
  RowMotion row_motion;
  bool has_row_motion() const { return row_motion.value.size() > 0; }
  // Rows without force: their accelerations are those of the motion without these rows. Only in functions that compute
  // accelerations; all others treat them as the other rows.
  void release_rows(Indices rows) { released_ = std::move(rows), released_configuration_ = -1; }
  bool has_released_rows() const { return !released_.empty(); }
  // Motion x with J x = 1 for one row, else 0, minimum-norm in the metric of D'. Released rows yield. False if J has
  // lost rank.
  bool unit_row_response(int row, Out x);
  const Tree& placed_tree() { return update_tree(), tree; }  // with the placements of all joints and the Jacobian
  double tolerance_scale() const { return tree.tolerance_scale(q_tree, scales.columns); }
  // Incremented by `set_configuration`. A caller that remembers it can tell whether the core has moved.
  long configuration_count = 0;
  void compute_J();
  void factorize_phi_z();
  void compute_rho();  // eq. 5
  void compute_D_tree();
  void compute_D();  // and factorize it
  bool is_D_computed() const { return is_valid(inertia_of_q); }
  Vector q_tree;
  Factor phi_z;
  DefiniteFactor D_factor;
  Matrix rho, D;  // (n, d), (d, d)
  void solve_z(In b, Out x) { phi_z.solve(b, x); }
  void closure_step_in_z(In residual, Out x);     // step x of z alone with J x = -residual; requires phi_z
  void multiply_D_tree(In x, Out product) const;  // D' x
  double joint_inertia(int k);  // inertia of a coordinate without the loops
  double potential_energy();
  Energy energy(In v, Out momentum);

  // --- terms that depend on v' ---
  void set_velocity(In v_tree);                              // at which the following terms are evaluated
  void compute_bias();                                       // C'v + h' without springs, J_dot v
  void compute_coriolis();                                   // C', J_dot, and h' without springs
  void compute_J_dot(In v_tree);                             // constraints.J_dot only
  void constraint_rate_derivative(In v_tree, Matrix& by_q);  // d (J v') / d q', tangent
  Vector v_tree, bias_tree, h_tree, J_dot_v;
  Vector damping_tree;                                            // forces of the dampers
  void multiply_rho(In q_dot, Out v) const;                       // rho q_dot
  void multiply_rho_transposed(In force, Out generalized) const;  // rho^T force
  void multiply_C_tree(In x, Out product);                        // C' x; requires compute_coriolis
  void multiply_rho_dot(In x, Out product);                       // requires compute_coriolis or compute_J_dot
  void multiply_C(In x, Out product);                             // requires compute_coriolis

  // --- accelerations ---
  //
  // Eq. 6 with v' = rho q_dot; with "actual", C uses the present v_tree instead.
  void reduced_acceleration(In u_tree, Out q_ddot);
  void actual_acceleration(In u_tree, In q_dot, Out q_ddot);
  void spf_z_dot(In q_dot, double epsilon, In w, Out z_dot);
  // Acceleration of the tree; requires `reduced_acceleration`.
  void tree_acceleration(In q_ddot, Out a) const;
  // Step x with J x = -residual, minimum-norm in the metric of D' (near a loss of rank, in the Euclidean metric of the
  // scaled coordinates). False if J has lost rank.
  bool closure_step(In residual, Out x);
  // The same in the Euclidean metric, along all directions that J determines.
  bool minimum_norm_closure_step(In residual, Out x);
  // One of the two, whichever is cheaper: a step of an iteration that projects onto the constraint manifold.
  bool cheapest_closure_step(In residual, Out x);
  // Basis of the velocities that the loops allow, (n, n - rank); null if J has lost rank. Each column belongs to one
  // of `basis_coordinates`.
  const Matrix* compute_tangent_basis();
  const Indices& basis_coordinates() const { return basis_coordinates_; }
  // A solution x of J x = -residual; requires a tangent basis.
  void particular_solution(In residual, Out x);
  // Acceleration of eq. 1, by elimination or by projection on the tangent space; `correction` is added to
  // J_dot v. False if J has lost rank.
  bool dae_acceleration(In u_tree, In correction, Out acceleration);
  // Elimination of eq. 1 without pivoting, by compiled terms, by articulated bodies or in sparse matrices. It may be used if
  // `allow_elimination` says so (loops/elimination_check.hpp decides). False if there is none, it is not allowed, or a
  // pivot is small.
  bool has_elimination() const { return compiled || articulated_ || sparse_; }
  void allow_elimination(bool allowed);
  bool eliminate(In u_tree, In correction, Out acceleration);
  bool elimination_step(In residual, Out x);  // as `closure_step`
  // Relative rounding errors of the acceleration at the core's state: of elimination compared with projection, and of
  // projection compared with projection by mass levels. Zero if the reference does not exist. Above `limit`, the
  // rounding of the reference is subtracted.
  double rounding_of_elimination(In u_tree, double limit);
  double rounding_of_projection(In u_tree);
  // Whether masses differ so much that projection may lose digits. With `use_mass_levels`, projection by mass levels
  // is used (core_levels.cpp).
  bool has_uneven_masses() const;
  void use_mass_levels(bool used) { uses_mass_levels_ = used; }
  bool uses_mass_levels() const { return uses_mass_levels_; }
  // `dae_acceleration` with holding forces on the locked joints, so that they stay at rest.
  bool acceleration_with_held_joints(In force, In correction, Out a);
  // Acceleration caused by a unit force on each of the given coordinates, one column each. False if J has lost rank.
  bool unit_force_responses(const Indices& at, Matrix& columns);
  // Bound the rounding errors of the accelerations of these coordinates, where the tree accelerates by `a` under
  // `force`.
  void acceleration_rounding(const Indices& at, const Matrix& columns, In force, In a, Vector& bound);
  // Distance of the holding forces from their bounds; requires `acceleration_with_held_joints`.
  double holding_margin() { return joints.holding_margin(rounding_); }
  // Requires `acceleration_with_held_joints`.
  Indices find_joints_at_force_limit() const { return joints.find_joints_at_force_limit(rounding_); }
  // Compute `derivatives` at the core's state, where the tree has this acceleration under u'. False if a number is
  // not finite.
  bool differentiate(In u_tree, In acceleration);
  DynamicsDerivatives derivatives;
  // Minimum-norm multipliers lambda of eq. 1 at the core's state, where the tree has this acceleration under u'.
  void multipliers(In u_tree, In acceleration, Out lambda);
  // Minimum-norm lambda with J^T lambda = force.
  void minimum_norm_multipliers(In force, Out lambda);
  // Solve for derivatives of the acceleration: for each column, D' a = force + J^T lambda and J a = -residual. False
  // if J has lost rank.
  bool solve_acceleration_derivatives(const Matrix& force, const Matrix& residual, Matrix& derivatives);
  // Derivatives of eq. 1's acceleration, with friction and holding forces, which are added to `force`. `with_u`: by_u
  // too. With compiled terms and no locked joint, the state may differ from the core's, and the acceleration itself is
  // not computed. False if J has lost rank.
  bool acceleration_derivatives(In q_tree, In v, In correction, AppliedForce& force, AccelerationDerivatives& result,
                                bool with_u = false);
  // `dae_acceleration` by compiled elimination, at any state. False if there is none or it would need a pivot.
  bool compiled_acceleration(In q_tree, In v_tree, In u_tree, In correction, Out acceleration) const;

 private:
  enum Part : unsigned {
    inertia_of_tree = 1,
    jacobian_of_rows = 2,
    factor_of_phi_z = 4,
    rho_of_phi_z = 8,
    inertia_of_q = 16,
    row_rates = 32,
    bias_of_tree = 64,
    coriolis_of_tree = 128,
    lengths_of_springs = 256,
    tree_is_set = 512,
  };
  bool is_valid(Part part) const { return valid_parts_ & part; }
  const std::vector<double>& D_entries() const { return compiled ? D_compiled_entries_ : tree.D_entries(); }
  void update_tree();
  void update_row_rates();  // and bias_without_springs_
  void update_spring_lengths();
  void compute_spring_forces();                            // into elastic_
  bool find_tangent_basis(In residual, double min_pivot);  // into tangent_, and x_ with J x = -residual
  void set_D_tree();  // from the entries that the tree has computed
  void restrict_inertia(const Indices& independent, const Matrix& basis, Matrix& restricted);
  void factorize_tangent_inertia();
  void add_force_response(In force, Out x);  // x = x_ plus the tangent motion that a force causes
  bool inertia_metric_step(In residual, double min_pivot, Out x);  // `closure_step` in the metric of D' only
  bool compute_released_directions();
  bool add_released_motion(In force, Out a);  // so that D' a = force along the motions of the released rows
  struct Components;                         // velocity components of the bodies
  void body_velocity_components(Components& of);
  bool find_basis_for_check();                      // by pivoting; the basis is not used later
  void project_on_tangent_space(In u_tree, Out a);  // eq. 1, requires tangent_ and x_
  void choose_elimination();
  bool eliminates() const;  // without compiled terms
  bool eliminates_by_bodies() const { return articulated_ && eliminates(); }
  ArticulatedBodies& placed_bodies();
  bool factorize_without_pivoting();
  void solve_by_factors(In force, In residual, Out a);
  bool project_by_mass_levels(In u_tree, Out a);    // the same; false if some motion moves no mass
  double relative_difference(In a, In reference);   // requires project_on_tangent_space
  bool find_basis_by_partition();
  bool find_basis_by_pivoting(double min_pivot);
  double largest_basis_entry() const;
  void take_pivots_as_partition();

  bool D_tree_is_dense_;
  bool uses_mass_levels_ = false;
  const Indices independent_rows_;
  std::unique_ptr<ArticulatedElimination> articulated_;  // at most one of them; none if projection is cheaper
  std::unique_ptr<SparseElimination> sparse_;
  bool elimination_allowed_ = true, elimination_is_accurate_ = false;
  // `configuration_count` of the last factorization without pivoting, and of the bodies' placement
  long factors_configuration_ = -1, bodies_configuration_ = -1;
  unsigned valid_parts_ = 0;  // bit set of `Part`: terms that are valid at q_tree and v_tree
  Matrix C_tree_, tangent_;
  Matrix D_tree_;  // D' as a matrix, its upper triangle; without compiled terms only if `D_tree_is_dense_`
  std::vector<double> D_compiled_entries_;  // entries of D_tree_ in the order of tree.inertia_pattern
  Matrix D_basis_, dependent_basis_, D_dependent_, D_between_;  // of `restrict_inertia`
  Indices dependent_;
  Indices basis_coordinates_;           // by column of the tangent basis: its coordinate
  Indices basis_q_, basis_z_, pivots_;  // partition of the tangent basis; independent of q and z
  Factor basis_;
  // Values of `configuration_count` at which tangent_ and basis_ were computed by that partition, and at which
  // tangent_factor_ was computed for it; -1 if they are not valid.
  long basis_configuration_ = -1, inertia_configuration_ = -1;
  Vector bias_without_springs_, x_, y_, elastic_, residual_, z_, d_, rho_dot_q_dot_;
  Eigen::ColPivHouseholderQR<Matrix> qr_;
  long qr_configuration_ = -1;  // `configuration_count` of qr_
  Eigen::CompleteOrthogonalDecomposition<Matrix> transposed_;
  Matrix tangent_matrix_, by_state_, force_derivative_, responses_;
  DefiniteFactor tangent_factor_;
  Vector rounding_, force_bound_;
  Indices released_;
  long released_configuration_ = -1;  // `configuration_count` of the next members
  Matrix released_directions_, released_inertia_;
  Vector released_force_, released_rates_;
  Vector householder_rhs_, minus_residual_, rho_times_x_, tangent_solution_, tangent_rhs_, unbalanced_force_, lambda_;
};

}  // namespace ckc
