#include "loops/spectrum.hpp"
#include "loops/two_rows.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace ckc {

constexpr int max_dense_rows = 8;              // up to this size a dense decomposition is as cheap
constexpr double breakdown_tolerance = 1e-14;  // relative off-diagonal entry at which the Krylov space is exhausted
constexpr int first_check = 4;                 // Lanczos steps before the first convergence check; doubled after each
// Residual of the eigenvector, relative to the eigenvalue. The relative error of the eigenvalue is its square.
constexpr double residual_tolerance = 1e-7;
// Of Rayleigh quotient iteration: largest number of rows, for which dense factorizations cost little, largest number of
// steps, residual of the eigenvector, relative to the eigenvalue, and distance below the eigenvalue, relative to it, in
// which no other eigenvalue may lie. A step converges cubically, so the residual is mostly much smaller.
constexpr int max_continued_rows = 24, max_continued_steps = 4;
constexpr double continued_residual_tolerance = 1e-3, min_eigenvalue_distance = 1e-4;
constexpr double rounding = std::numeric_limits<double>::epsilon();

// Start vector. Equal entries could be orthogonal to the smallest singular direction of a symmetric mechanism.
static void fill_generic_vector(Out u) {
  for (Eigen::Index k = 0; k < u.size(); ++k) u(k) = 1.0 + 0.1 * static_cast<double>(k % 7);
}

SmallestSingularValue::SmallestSingularValue(std::vector<Indices> pattern, int columns, int rank)
    : pattern_(std::move(pattern)), rank_(rank) {
  const int m = static_cast<int>(pattern_.size());
  is_dense_ = m <= max_dense_rows || rank < m;
  scaled_.setZero(m, columns), gram_.setZero(m, m), u_.setZero(m);
  std::vector<Indices> coupled_rows(m), rows_of_column(columns), common_columns(m);
  for (int i = 0; i < m; ++i)
    for (int j : pattern_[i]) rows_of_column[j].push_back(i);
  for (int a = 0; a < m; ++a) {
    for (int j : pattern_[a])
      for (int b : rows_of_column[j]) {
        if (common_columns[b].empty()) coupled_rows[a].push_back(b);
        common_columns[b].push_back(j);
      }
    std::sort(coupled_rows[a].begin(), coupled_rows[a].end());
    for (int b : coupled_rows[a]) {
      if (b <= a) pairs_.push_back({a, b, common_columns[b]});
      common_columns[b].clear();
    }
  }
  may_continue_ = rank == m && m > 2 && m <= max_continued_rows;
  if (may_continue_) {
    shifted_.setIdentity(m, m), next_.setZero(m);
    shifted_cholesky_.compute(shifted_);
  }
  factor_.set_pattern(m, m, is_dense_ ? full_pattern(m) : coupled_rows);
  if (!is_dense_) basis_.setZero(m, max_steps_), next_.setZero(m), projections_.setZero(max_steps_);
  // A solver that has computed nothing cannot be copied, so use it once.
  const int size = is_dense_ ? std::max(m, 1) : 1;
  eigen_.compute(Matrix::Identity(size, size), Eigen::EigenvaluesOnly);
  ritz_.compute(Eigen::Matrix<double, max_steps_, max_steps_>::Identity(), Eigen::EigenvaluesOnly);
}

void SmallestSingularValue::compute(const Matrix& a, In row_scale, In column_scale, bool continues) {
  for (size_t i = 0; i < pattern_.size(); ++i)
    for (int j : pattern_[i]) scaled_(i, j) = row_scale(i) * a(i, j) * column_scale(j);
  for (const Pair& pair : pairs_) {
    double sum = 0.0;
    for (int j : pair.columns) sum += scaled_(pair.a, j) * scaled_(pair.b, j);
    gram_(pair.a, pair.b) = gram_(pair.b, pair.a) = sum;
  }
  mean_square_ = gram_.trace() / rank_;
  if (continues && vector_is_computed_ && continue_from_last_vector()) return;
  vector_is_computed_ = false;
  is_dense_ ? compute_dense() : compute_sparse();
}

bool SmallestSingularValue::continue_from_last_vector() {
  if (!may_continue_) return false;
  const double floor = 4 * rounding * gram_.trace();
  for (int k = 0;; ++k) {
    next_.noalias() = gram_ * u_;
    smallest_ = u_.dot(next_);
    next_ -= smallest_ * u_;
    if (next_.norm() <= std::max(continued_residual_tolerance * smallest_, floor)) break;
    if (k == max_continued_steps) return false;
    shifted_ = gram_;
    shifted_.diagonal().array() -= smallest_ - floor;
    factor_.compute(shifted_);
    factor_.solve(u_, u_);
    u_.normalize();
    if (!u_.allFinite()) return false;
  }
  shifted_ = gram_;
  shifted_.diagonal().array() -= smallest_ - (min_eigenvalue_distance * smallest_ + floor);
  shifted_cholesky_.compute(shifted_);
  return shifted_cholesky_.info() == Eigen::Success;
}

void SmallestSingularValue::compute_dense() {
  if (has_closed_form()) return find_smallest_eigenvalue(gram_(0, 0), gram_(1, 1), gram_(0, 1), smallest_);
  eigen_.compute(gram_, Eigen::EigenvaluesOnly);
  smallest_ = eigen_.eigenvalues()(gram_.rows() - rank_);
}

void SmallestSingularValue::compute_sparse() {
  factor_.compute(gram_);
  // Where a pivot is exactly zero, a shift by rounding errors keeps the vector.
  if (factor_.singular()) gram_.diagonal().array() += rounding * mean_square_, factor_.compute(gram_);
  smallest_ = 1.0 / largest_eigenvalue_of_inverse();
  vector_is_computed_ = true;
}

// The one of largest magnitude, by Lanczos' method with full orthogonalization (twice), which is affordable for few
// steps. The vector is stored in u_.
double SmallestSingularValue::largest_eigenvalue_of_inverse() {
  fill_generic_vector(u_);
  u_.normalize();
  basis_.col(0) = u_;
  for (int k = 0, next_check = first_check;; ++k) {
    factor_.solve(basis_.col(k), next_);
    diagonal_(k) = basis_.col(k).dot(next_);
    const auto basis = basis_.leftCols(k + 1);
    for (int pass = 0; pass < 2; ++pass) {
      projections_.head(k + 1).noalias() = basis.transpose() * next_;
      next_.noalias() -= basis * projections_.head(k + 1);
    }
    off_diagonal_(k) = next_.norm();
    if (has_ended(k) || k + 1 == next_check) {
      next_check *= 2;
      ritz_.computeFromTridiagonal(diagonal_.head(k + 1), off_diagonal_.head(k));
      // Where A loses rank, rounding may make the smallest eigenvalue of A A^T negative.
      const int largest = -ritz_.eigenvalues()(0) > ritz_.eigenvalues()(k) ? 0 : k;
      const double value = ritz_.eigenvalues()(largest);
      const auto vector = ritz_.eigenvectors().col(largest);
      if (has_ended(k) || off_diagonal_(k) * std::abs(vector(k)) <= residual_tolerance * std::abs(value)) {
        u_.noalias() = basis * vector;
        return value;
      }
    }
    basis_.col(k + 1) = next_ / off_diagonal_(k);
  }
}

bool SmallestSingularValue::has_ended(int k) const {
  return k + 1 == max_steps_ || !(off_diagonal_(k) > breakdown_tolerance * std::abs(diagonal_(0)));
}

void SmallestSingularValue::compute_vectors(Vector& u, Vector& v) {
  if (is_dense_ && !vector_is_computed_) {  // inverse iteration, shifted by the eigenvalue
    gram_.diagonal().array() -= smallest_ + 1e-12 * mean_square_;
    factor_.compute(gram_);
    fill_generic_vector(u_);
    for (int k = 0; k < 2; ++k) {
      factor_.solve(u_, u_);
      u_.normalize();
    }
    vector_is_computed_ = true;
  }
  u = u_;
  v.setZero(scaled_.cols());
  for (size_t i = 0; i < pattern_.size(); ++i)
    for (int j : pattern_[i]) v(j) += scaled_(i, j) * u(i);
}

}  // namespace ckc
