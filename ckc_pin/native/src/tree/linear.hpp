// Matrix factorizations that allocate nothing after their first use.
#pragma once

#include <Eigen/Cholesky>

#include "tree/types.hpp"

namespace ckc {

// LU factorization with row pivoting of a square matrix, or QR factorization of a tall one, with solves.
//
// The constraint rows of one loop involve few columns. Each row therefore stores the interval of its nonzero entries
// only, and elimination works on these intervals. Columns are sorted by the first row that involves them. Independent
// loops then cost as much as each one alone, and a chain of loops costs as much as a banded matrix.
class Factor {
 public:
  // Set the size of the matrices and their sparsity pattern: by row, the columns that are not zero. `places`: by row,
  // where these entries are in a list of entries.
  void set_pattern(int rows, int columns, const std::vector<Indices>& pattern, const std::vector<Indices>& places = {});
  void compute(const Matrix& a);  // entries outside the pattern must be zero
  void compute(const std::vector<double>& entries);
  void solve(In b, Out x);             // least squares if the matrix is tall
  void solve_transposed(In b, Out x);  // minimum-norm solution of A^T x = b; tall matrices only
  bool singular() const { return singular_; }
  double pivot_ratio() const;  // smallest pivot divided by the largest

 private:
  double* row(int i) { return values_.data() + row_start_[i]; }  // of L U: its entry k in place k
  double pivot(int k) const;                                    // zero if no row has an entry for it
  void extend_row(int i, int end);
  template <class Entry>
  void compute_from(const Entry& entry);  // entry(i, p): that of the p-th column in the pattern of row i
  void eliminate();
  void eliminate_small();
  void householder();

  int rows_ = 0, columns_ = 0;
  std::vector<Indices> pattern_, places_;
  Indices column_at_;    // column_at_[k]: column of the matrix that is eliminated as the k-th
  Indices position_of_;  // inverse of column_at_
  std::vector<double> values_;             // of L U; zero behind the interval of a row
  std::vector<std::ptrdiff_t> row_start_;  // by row: where its entry 0 would be in values_
  Indices row_capacity_;                   // by row: largest end of its interval for which there is space
  Matrix qr_;
  Vector tau_, work_;
  Indices row_begin_, row_end_;            // by row: its interval
  Indices row_at_;                         // rows in pivot order
  std::vector<Indices> rows_starting_at_;  // by column: rows whose interval begins there
  Indices eliminated_rows_;                // rows that the elimination of a column changed, one column after another
  Indices eliminated_end_;                 // by column: the end of its rows there
  Indices active_rows_;                    // rows that have started and are not yet pivots
  bool is_small_ = false, singular_ = false;
};

// Cholesky factorization of a symmetric positive definite matrix. Small matrices use LU instead, which is faster.
class DefiniteFactor {
 public:
  void resize(int size);
  void compute(const Matrix& a);
  void solve(In b, Out x);

 private:
  Factor small_;
  Eigen::LLT<Matrix> large_;
  bool is_small_ = true;
};

// Sparsity pattern of a dense square matrix.
std::vector<Indices> full_pattern(int size);

}  // namespace ckc
