// A mechanism's terms at one state, each computed when it is first asked for, and accelerations as functions of them.
//
// Everything is kept in the object and overwritten by the next state: nothing is allocated after construction, but
// for a tangent basis that changes its partition, and next to a loss of rank.
#pragma once

#include <Eigen/QR>

#include "loops/derivatives.hpp"
#include "loops/joints.hpp"
#include "tree/linear.hpp"
#include "loops/rows.hpp"
#include "tree/springs.hpp"
#include "loops/profile.hpp"

namespace ckc {

class Written;

struct Energy {
  double kinetic, potential;  // of gravity and springs, J
  double total() const { return kinetic + potential; }
};

struct Scales {
  Vector rows, columns;  // what makes J free of units
  double rank;           // relative size of a pivot of the scaled J that counts as zero
};

class Core {
 public:
  Core(const std::string& model, Indices place, Closure closure, SpringTable springs, JointTable joints, int rank,
       Scales scales, std::unique_ptr<Written> written);
  ~Core();

  void split(Indices q, Indices z);  // the partition q' = [q; z]

  // Other numbers of the mechanism, in the parts that `ckc_pin.generated.arguments` has them in, and what the code that
  // is written out takes; nothing that was computed before is known after it.
  enum class Number {
    gravity, offset, mass, centre, inertia, armature, point, length, affine, affine_offset, end, stiffness, rest_length,
    damping, joint_stiffness, joint_rest, joint_damping, constant, written,
  };
  Eigen::Index size_of(Number what) const;
  void vary(Number what, In numbers);
  // Whether det phi_z is negative here; false where phi_z is not square.
  bool reversed();

  Tree tree;
  Rows rows;
  Springs springs;
  Joints joints;
  const int n, rank;
  const Scales scales;
  int d;
  Indices q, z;
  Profile profile;
  std::unique_ptr<Written> written;  // the terms of the tree and the rows; null: Pinocchio's

  // --- at a configuration ---
  void set(In q_tree, bool with_inertia = false);  // phi and placements; D' in the same sweep
  double coarseness() const { return tree.coarseness(q_tree, scales.columns); }
  long sets = 0;              // how often that was: who remembers it knows whether the core is where it was left
  void jacobian();            // J
  void factor();              // phi_z
  void reduce();              // rho, eq. 5
  void tree_inertia();        // D'
  void inertia();             // D, factorized
  Vector q_tree;
  Factor phi_z;
  Definite D_factor;
  Matrix rho, D;              // (n, d), (d, d)
  void solve_z(In b, Out x) { phi_z.solve(b, x); }
  void z_step(In residual, Out x);  // the x with J x = -residual that moves z alone; phi_z is factorized
  void D_times(In x, Out product) const;  // D' x
  double inertia_alone(int k) const { return D_tree()(k, k); }  // of a coordinate that moves without the loops
  double potential_energy();
  Energy energy(In v, Out momentum);

  // --- at a velocity ---
  void set_velocity(In v_tree);  // that of what follows
  void bias();                // C'v + h' less springs, J_dot v
  void coriolis();            // C', J_dot and h' less springs
  void jacobian_rate(In v_tree);  // rows.J_dot alone
  void closure_rate(In v_tree, Matrix& by_q);  // how J v' changes with q', tangent
  Vector v_tree, bias_tree, h_tree, J_dot_v;
  Vector damping_tree;        // what dampers do, zero without
  void velocity(In q_dot, Out v) const;           // rho q_dot
  void reduced(In force, Out generalized) const;  // rho^T force
  void C_tree_times(In x, Out product);           // C' x, after coriolis
  void rho_dot_times(In x, Out product);          // after coriolis, or jacobian_rate
  void C_times(In x, Out product);                // after coriolis

  // --- accelerations ---
  // Eq. 6 at v' = rho q_dot; and at any v' that C takes its velocity from ("actual").
  void reduced_acceleration(In u_tree, Out q_ddot);
  void actual_acceleration(In u_tree, In q_dot, Out q_ddot);
  void spf_z_dot(In q_dot, double epsilon, In w, Out z_dot);
  // Of the tree, after `reduced_acceleration`.
  void tree_acceleration(In q_ddot, Out a) const;
  // The x with J x = -residual that is smallest in the metric of D', next to a loss of rank in that of the coordinates;
  // false where J has lost rank.
  bool closing_step(In residual, Out x);
  // The same in the metric of the coordinates, along every direction that J determines at all.
  bool shortest_step(In residual, Out x);
  // Either, the one that costs less: from a state that an iteration closes anyway.
  bool step_onto_closure(In residual, Out x);
  // Basis of the velocities that the loops allow, (n, n - rank), and the coordinates that its columns are of; null where
  // J has lost rank.
  const Matrix* tangent();
  const Indices& free() const { return free_; }
  // An x with J x = -residual, where there is a tangent basis.
  void particular(In residual, Out x);
  // Eq. 1, written out or by projection on the tangent space of the closure; false where J has lost rank.
  bool dae_acceleration(In u_tree, In correction, Out acceleration);
  // Relative rounding errors of eq. 1's acceleration at the core's state: of the compiled elimination against projection, even
  // where elimination is not allowed, and of projection against projection by levels. Zero where either does not exist.
  double rounding_of_elimination(In u_tree);
  double rounding_of_projection(In u_tree);
  // Whether masses are so unequal that projection may lose digits; it is then done by levels of masses, where that is asked for.
  bool has_uneven_masses() const;
  void use_levels(bool used) { uses_levels_ = used; }
  bool uses_levels() const { return uses_levels_; }
  // The same as `dae_acceleration` where the locked joints rest.
  bool eq_1(In force, In correction, Out a);
  // What a unit force on each of some coordinates adds to the acceleration, as columns; false where J has lost rank.
  bool responses(const Indices& at, Matrix& columns);
  // What rounding may make of the accelerations of these coordinates, where the tree accelerates by `a` under `force`.
  void acceleration_rounding(const Indices& at, const Matrix& columns, In force, In a, Vector& bound);
  // How far what holds the locked joints is from giving way, after `eq_1`.
  double holding_margin() { return joints.margin(rounding_); }
  Indices at_limit() const { return joints.at_limit(rounding_); }  // of the locked joints, there
  // How the terms change at the core's state, where the tree accelerates under u'; false where nothing tells J^T lambda.
  bool differentiate(In u_tree, In acceleration);
  Derivatives derivatives;
  // The least lambda for which J^T lambda is this.
  void multipliers(In force, Out lambda);
  // How eq. 1's acceleration changes with forces and with what J a is to lack, a column each; false where J has lost rank.
  bool respond(const Matrix& force, const Matrix& residual, Matrix& change);
  // How the acceleration of eq. 1 changes with (q', v'), tangent, and with u', where `force` acts and changes as `u_by_q`
  // and `u_by_v`, none where they are empty; what joints do is added to those. At the core's state, which may be another
  // one where its terms are written out and no joint is locked, so that `a` is not computed. False where J has lost rank.
  bool slopes(In q_tree, In v, In correction, Vector& force, Matrix& u_by_q, Matrix& u_by_v, Vector& a, Matrix& by_q,
              Matrix& by_v, Matrix* by_u = nullptr);
  // The same as `dae_acceleration` at any state, whatever the core's; false where there is no such code, or where it would have to pivot.
  bool written_acceleration(In q_tree, In v_tree, In u_tree, In correction, Out acceleration) const;

 private:
  enum Part : unsigned {
    inertia_of_tree = 1, jacobian_of_rows = 2, factor_of_phi_z = 4, rho_of_phi_z = 8, inertia_of_q = 16, row_rates = 32,
    bias_of_tree = 64, coriolis_of_tree = 128, lengths_of_springs = 256, tree_is_set = 512,
  };
  bool has(Part part) const { return here_ & part; }
  const Matrix& D_tree() const { return written ? D_written_ : tree.D(); }
  void set_tree();
  void row_rates_of_tree();  // and bias_without_springs_
  void spring_lengths();
  void spring_forces();  // elastic_
  bool tangent_basis(In residual, double least);  // tangent_, and x_: J x = -residual
  void tangent_inertia();                         // factorized
  void with_force(In force, Out x);               // x_ with what a force makes of the tangent directions
  struct Components;                              // of the bodies' velocities
  void components(Components& of);
  bool basis_for_check();                         // tangent_ and x_ by pivoting, forgotten again
  void project(In u_tree, Out a);                 // eq. 1 where tangent_ and x_ are known
  bool project_by_levels(In u_tree, Out a);       // the same; false where a motion moves no mass
  double off(In a, In right);                     // relative, after `project`
  bool basis_by_partition();
  bool basis_by_pivoting(double least);
  double steepness() const;
  void repartition();

  bool dense_;          // whether D' is
  bool uses_levels_ = false;
  unsigned here_ = 0;  // parts that are those of q_tree and v_tree
  Matrix C_tree_, D_written_, D_rho_, tangent_, D_tangent_;
  Indices free_;  // the coordinates that the tangent basis' columns are of
  Indices basis_q_, basis_z_, pivots_;  // the partition that the tangent basis is of, whichever is good here
  Factor basis_;
  long basis_at_ = -1;  // `sets` when tangent_ and basis_ were made of that partition, else -1
  Vector bias_without_springs_, x_, y_, elastic_, residual_, z_, d_, rho_dot_q_dot_;
  long inertia_at_ = -1;  // the same of square_factor_
  Eigen::ColPivHouseholderQR<Matrix> qr_;
  Eigen::CompleteOrthogonalDecomposition<Matrix> transposed_;
  Matrix square_, by_state_, by_u_, change_, responses_;
  Definite square_factor_;
  Vector rounding_, effort_bound_;
  Vector turned_, negative_, moved_, small_, small_b_, effort_, lambda_;
};

}  // namespace ckc
