// The least singular value of a wide matrix, few of whose entries are not zero, and how large they are.
#pragma once

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

#include "tree/linear.hpp"

namespace ckc {

// From A A^T, so the least one is exact to eps times the square of their ratio.
//
// A small matrix, or one that lacks rank, is decomposed whole. For a large one that costs its rows cubed; it has the
// least eigenvalue looked for by Lanczos' method on the inverse of A A^T, whose factors are as sparse as the loops are.
class Spectrum {
 public:
  // The pattern by rows; `rank`: how many singular values are not zero whatever the state.
  Spectrum(std::vector<Indices> pattern, int columns, int rank);

  void compute(const Matrix& a, In row_scale, In column_scale);  // of the scaled matrix; not read outside the pattern
  double mean() const { return std::sqrt(mean_); }  // the root of their mean square
  double least() const { return std::sqrt(std::max(least_, 0.0)); }
  // Singular vectors of the least: u of unit length, and v = A^T u, whose length is that value to rounding.
  void vectors(Vector& u, Vector& v);

 private:
  static constexpr int steps_ = 16;  // of Lanczos' method, at most
  using Small = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, steps_, steps_>;

  void dense();
  void sparse();
  double most_of_inverse();  // its largest eigenvalue by Lanczos' method
  bool ended(int k) const;   // whether no step can follow the k-th

  struct Pair {  // of rows that meet common columns
    int a, b;
    Indices columns;
  };
  std::vector<Indices> pattern_;
  std::vector<Pair> pairs_;
  int rank_;
  bool whole_;
  double mean_ = 0.0, least_ = 0.0;
  Matrix scaled_, gram_, basis_;
  Vector u_, next_, along_;
  Eigen::Matrix<double, steps_, 1> diagonal_, beside_;  // of what Lanczos' method makes of the matrix
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;  // values only: vectors would allocate
  Eigen::SelfAdjointEigenSolver<Small> ritz_;
  Factor factor_;
};

}  // namespace ckc
