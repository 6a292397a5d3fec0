// Smallest singular value of a sparse wide matrix, relative to its size.
#pragma once

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "tree/linear.hpp"

namespace ckc {

// Smallest nonzero singular value of A, from the eigenvalues of A A^T. Its error is eps times the squared condition
// number.
//
// Small or rank-deficient matrices are decomposed densely, at a cost of rows cubed. For large ones, Lanczos' method
// finds the largest eigenvalue of the inverse of A A^T, whose factors are as sparse as the loops. Along a motion,
// Rayleigh quotient iteration from the last vector costs a quarter of both; a Cholesky factorization then shows that no
// other eigenvalue is smaller.
class SmallestSingularValue {
 public:
  // `pattern`: nonzero columns by row. `rank`: number of singular values that are not zero at a regular state.
  SmallestSingularValue(std::vector<Indices> pattern, int columns, int rank);

  // Scale rows and columns, then compute. Entries outside the pattern are ignored. `continues`: begin with the last
  // vector, if there is one.
  void compute(const Matrix& a, In row_scale, In column_scale, bool continues = false);
  void forget_vector() { vector_is_computed_ = false; }
  double root_mean_square() const { return std::sqrt(mean_square_); }  // of the nonzero singular values
  double value() const { return std::sqrt(std::max(smallest_, 0.0)); }
  // Compute the singular vectors of the smallest singular value: u of unit length, and v = A^T u, whose length is
  // that value.
  void compute_vectors(Vector& u, Vector& v);

 private:
  static constexpr int max_steps_ = 16;  // Lanczos steps
  using Small = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, max_steps_, max_steps_>;

  bool has_closed_form() const { return gram_.rows() == 2 && rank_ == 2; }  // one planar loop
  bool continue_from_last_vector();  // false: it does not lead to the smallest eigenvalue
  void compute_dense();
  void compute_sparse();
  double largest_eigenvalue_of_inverse();  // by Lanczos' method
  bool has_ended(int k) const;             // whether step k is the last possible one

  struct Pair {  // two rows with common nonzero columns
    int a, b;
    Indices columns;
  };
  std::vector<Indices> pattern_;
  std::vector<Pair> pairs_;
  int rank_;
  bool is_dense_, may_continue_, vector_is_computed_ = false;
  double mean_square_ = 0.0, smallest_ = 0.0;
  Matrix scaled_, gram_, basis_;
  Vector u_, next_, projections_;
  Eigen::Matrix<double, max_steps_, 1> diagonal_, off_diagonal_;  // of Lanczos' tridiagonal matrix
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_;                   // values only: vectors would allocate
  Eigen::SelfAdjointEigenSolver<Small> ritz_;
  Factor factor_;
  Matrix shifted_;
  Eigen::LLT<Matrix> shifted_cholesky_;
};

}  // namespace ckc
