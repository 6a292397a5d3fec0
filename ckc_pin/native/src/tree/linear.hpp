// Matrix factorizations that allocate nothing after their first use.
#pragma once

#include <Eigen/Cholesky>

#include "tree/types.hpp"

namespace ckc {

// LU factorization with row pivoting of a square matrix, or QR factorization of a tall one, with solves.
//
// The constraint rows of one loop involve few columns. Each row therefore stores the interval of its nonzero entries,
// and elimination works on these intervals. Columns are sorted by the first row that involves them. Independent loops
// then cost as much as each one alone, and a chain of loops costs as much as a banded matrix.
class Factor {
 public:
  // Set the size of the matrices and their sparsity pattern: by row, the columns that are not zero.
  void set_pattern(int rows, int columns, const std::vector<Indices>& pattern);
  // Factorize the given columns of a matrix (all if `columns` is empty). Entries outside the pattern must be zero.
  void compute(const Matrix& a, const Indices& columns = {});
  void solve(In b, Out x);             // least squares if the matrix is tall
  void solve_transposed(In b, Out x);  // minimum-norm solution of A^T x = b; tall matrices only
  bool singular() const { return singular_; }
  double pivot_ratio() const;  // smallest pivot divided by the largest

 private:
  void eliminate();
  void eliminate_small();
  void householder();

  int rows_ = 0, columns_ = 0;
  std::vector<Indices> pattern_;
  Indices column_at_;    // column_at_[k]: column of the matrix that is eliminated as the k-th
  Indices position_of_;  // inverse of column_at_
  Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> lu_;
  Matrix qr_;
  Vector tau_, work_;
  Indices row_begin_, row_end_;            // by row: its interval
  Indices row_at_;                         // rows in pivot order
  std::vector<Indices> rows_starting_at_;  // by column: rows whose interval begins there
  std::vector<Indices> eliminated_rows_;   // by column: rows that its elimination changed
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
