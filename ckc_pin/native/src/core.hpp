// A mechanism's terms at one state, and the formulations as functions of them.
//
// Everything is kept in the object and overwritten by the next state: nothing is allocated after construction, but
// for a tangent basis that changes its partition.
#pragma once

#include <Eigen/QR>

#include "linear.hpp"
#include "rows.hpp"
#include "springs.hpp"

namespace ckc {

class Core {
 public:
  Core(const std::string& model, Indices place, Closure closure, SpringTable springs, int rank);

  void split(Indices q, Indices z);  // the partition q' = [q; z]

  Tree tree;
  Rows rows;
  Springs springs;
  int n, d, rank;
  Indices q, z;

  // --- at a configuration ---
  void set(In q_tree, bool with_inertia = false);  // phi and placements; D' in the same sweep
  long sets = 0;              // how often that was: who remembers it knows whether the core is where it was left
  void factor();              // J and phi_z's factorization
  void reduce();              // rho, eq. 5
  Vector q_tree;
  Factor phi_z;
  Matrix rho;                 // (n, d)
  void solve_z(In b, Out x) { phi_z.solve(b, x); }

  // --- at a velocity ---
  void inertia();             // D' and D
  void bias(In v_tree);       // C'v + h' less springs, J_dot v
  void rates(In v_tree);      // of the rows alone, as `bias` leaves them
  void coriolis();            // after `bias`: C', J_dot and h' less springs
  void D_times(In x, Out product) const;
  void velocity(In q_dot, Out v) const;   // rho q_dot
  void reduced(In force, Out generalized) const;  // rho^T force
  void C_times(In x, Out product);        // after coriolis
  Vector v_tree, bias_tree, h_tree, J_dot_v;
  Matrix D, C_tree;
  Factor D_factor;

  // --- accelerations ---
  // Eq. 6 at v' = rho q_dot; and at any v' that C takes its velocity from ("actual").
  void reduced_acceleration(In u_tree, Out q_ddot);
  void actual_acceleration(In u_tree, In q_dot, Out q_ddot);
  void spf_z_dot(In q_dot, double epsilon, In w, Out z_dot);
  // The x with J x = -residual that is smallest in the metric of D'; false where J has lost rank, or nearly so.
  bool closing_step(In residual, Out x);
  // The same in the metric of the coordinates, along every direction that J determines at all.
  bool shortest_step(In residual, Out x);
  // Eq. 1 by projection on the tangent space of the closure; false where J has lost rank.
  bool dae_acceleration(In u_tree, In correction, Out acceleration);

 private:
  bool tangent_basis(In residual, double least);  // tangent_, and x_: J x = -residual
  void tangent_inertia();                         // factorized
  void with_force(In force, Out x);               // x_ with what a force makes of the tangent directions
  bool basis_by_partition();
  bool basis_by_pivoting(double least);
  void repartition();
  bool D_here_ = false;  // whether the tree's D' is that of q_tree
  bool rates_here_ = false;  // whether the rows' rates are those of v_tree
  Matrix D_rho_, tangent_, D_tangent_;
  Indices basis_q_, basis_z_, pivots_;  // the partition that the tangent basis is of, whichever is good here
  Factor basis_;
  long basis_at_ = -1;  // `sets` when tangent_ and basis_ were made of that partition, else -1
  Vector x_, y_, elastic_, residual_, z_, d_;
  Eigen::ColPivHouseholderQR<Matrix> qr_;
  Matrix square_;
  Factor square_factor_;
  Vector turned_, negative_, moved_, small_, small_b_;
};

}  // namespace ckc
