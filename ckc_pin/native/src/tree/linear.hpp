// Factorizations without allocation after the first use.
#pragma once

#include <Eigen/Cholesky>

#include "tree/types.hpp"

namespace ckc {

// LU with row pivoting of a square matrix, QR of a tall one, with solves by either.
//
// The rows of a closure that hold one loop meet few columns. Each row keeps the interval of its entries that are not
// zero, and elimination works on the intervals: with the columns in the order in which the rows meet them, loops
// that are independent cost what each costs alone, and a chain of loops what a band costs.
class Factor {
 public:
  // Columns in the order of the first row that meets them, by the pattern of a (rows, columns) matrix.
  void shape(int rows, int columns, const std::vector<Indices>& pattern);
  // Of columns of a matrix (all when none are named); entries outside the pattern are zero.
  void compute(const Matrix& a, const Indices& columns = {});
  void solve(In b, Out x);            // least squares when tall
  void solve_transposed(In b, Out x); // A^T x = b, of minimum norm; of a tall matrix only
  bool singular() const { return singular_; }
  double pivot_ratio() const;         // the smallest pivot to the largest

 private:
  void eliminate();
  void eliminate_small();
  void householder();

  int rows_ = 0, columns_ = 0;
  std::vector<Indices> pattern_;
  Indices column_at_;                 // column_at_[k]: which column of the matrix is the k-th here
  Indices place_of_;                  // its inverse
  Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> lu_;
  Matrix qr_;
  Vector tau_, work_;
  Indices high_, row_at_;             // ends of the intervals, and where pivoting put the rows
  std::vector<Indices> beginning_;    // by column: rows whose interval begins there
  std::vector<Indices> below_;        // by column: rows that its elimination touched
  Indices active_;                    // rows met and not yet pivots
  bool small_ = false, singular_ = false;
};

// Cholesky's factorization of a symmetric positive definite matrix; a small one is eliminated as it is.
class Definite {
 public:
  void shape(int size);
  void compute(const Matrix& a);
  void solve(In b, Out x);

 private:
  Factor small_;
  Eigen::LLT<Matrix> large_;
  bool few_ = true;
};

// The pattern of a full square matrix.
std::vector<Indices> full_pattern(int size);

}  // namespace ckc
