// Sparse elimination of eq. 1 without pivoting: L diag L^T of [D', J^T; J, 0] in an order that is computed once.
//
// Projection on the tangent space costs d^3 for d freedoms. Here, branches of the tree stay independent until they meet.
// A row is eliminated only after all coordinates that it depends on. Pivots of coordinates are then positive and pivots
// of independent rows negative at every state, for all masses.
#pragma once

#include "tree/types.hpp"

namespace ckc {

// Place of the first entry of each row (or column) of a pattern in a list of all entries, and their number.
Indices first_entries(const std::vector<Indices>& pattern);

class SparseElimination {
 public:
  // `inertia_pattern`: by coordinate j, the rows i <= j of D' that may be different from zero. `row_pattern`: by row of J,
  // its columns. `kept`: independent rows of J; the others are left out.
  SparseElimination(const std::vector<Indices>& inertia_pattern, const std::vector<Indices>& row_pattern, Indices kept);

  // Multiplications of one factorization and one solution.
  long operations() const { return operations_; }
  // Factorize, from the entries of D' and J in the order of their patterns. False if a pivot is so small that digits
  // are lost.
  bool compute(const std::vector<double>& D_entries, const std::vector<double>& J_entries);
  // Solve D' a = force + J^T lambda, J a = -residual, with one step of iterative refinement: J D'^-1 J^T has the square of
  // J's condition number.
  void solve(In force, In residual, Out a);
  // Solve the same for unit forces on these coordinates, one column each, with J a = 0.
  void solve_unit_forces(const Indices& at, Matrix& columns);
  // Solve D' a = force without rows and without refinement.
  void solve_without_rows(In force, Out a);

 private:
  static constexpr int block_size = 8;  // right-hand sides of which each entry of L is applied to all at a time
  // Entries below one another in one column of L, from which a multiple of entries of an earlier column is subtracted.
  struct Run {
    int target, source, length;
  };
  struct Entry {
    int index, source;  // index into values_, and among the entries of D' or J
    int place_of_row, place_of_column;
    double value;
  };
  template <class Unknowns>
  void solve_refined(Unknowns& solution, Unknowns& residual) const;
  template <class Unknowns>
  void substitute(Unknowns& x) const;
  Indices choose_order(std::vector<std::vector<char>>& coupled) const;

  int n_;
  Indices kept_;
  std::vector<bool> is_row_;     // by place in the order
  Indices place_;                // of the coordinates, then of the kept rows
  Indices column_start_;         // by place: index of its diagonal entry in values_
  Indices place_of_value_;       // by entry of L: the place of its row
  std::vector<Entry> inertia_entries_, jacobian_entries_;
  Indices first_run_;            // by entry of L: the updates that subtract a multiple of it
  std::vector<Run> runs_;
  long operations_ = 0;
  Vector values_, sums_, inverses_, solution_, residual_;
  Eigen::Matrix<double, Eigen::Dynamic, block_size, Eigen::RowMajor> solutions_, residuals_;
};

}  // namespace ckc
