#include "loops/spectrum.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <utility>

namespace ckc {

constexpr int small = 8;             // rows, up to which decomposing it whole is as cheap
constexpr double exhausted = 1e-14;  // of the matrix' size: what the next direction is short of being one
constexpr int first = 4;             // steps, after which it is looked whether they are enough; then after twice as many
constexpr double exact = 1e-7;       // of the eigenvalue: what its vector may leave; its square is what the value is off by

// A vector that no symmetry of a mechanism is orthogonal to.
static void along_nothing(Out u) {
  for (Eigen::Index k = 0; k < u.size(); ++k) u(k) = 1.0 + 0.1 * static_cast<double>(k % 7);
}

Spectrum::Spectrum(std::vector<Indices> pattern, int columns, int rank) : pattern_(std::move(pattern)), rank_(rank) {
  const int m = static_cast<int>(pattern_.size());
  whole_ = m <= small || rank < m;
  scaled_.setZero(m, columns), gram_.setZero(m, m), u_.setZero(m);
  std::vector<Indices> meets(m);
  for (int a = 0; a < m; ++a)
    for (int b = 0; b < m; ++b) {
      Indices columns_of_both;
      std::set_intersection(pattern_[a].begin(), pattern_[a].end(), pattern_[b].begin(), pattern_[b].end(),
                            std::back_inserter(columns_of_both));
      if (columns_of_both.empty()) continue;
      meets[a].push_back(b);
      if (b <= a) pairs_.push_back({a, b, std::move(columns_of_both)});
    }
  factor_.shape(m, m, whole_ ? full_pattern(m) : meets);
  if (!whole_) basis_.setZero(m, steps_), next_.setZero(m), along_.setZero(steps_);
  // Solvers cannot be copied before their first use.
  const int size = whole_ ? std::max(m, 1) : 1;
  eigen_.compute(Matrix::Identity(size, size), Eigen::EigenvaluesOnly);
  ritz_.compute(Eigen::Matrix<double, steps_, steps_>::Identity(), Eigen::EigenvaluesOnly);
}

void Spectrum::compute(const Matrix& a, In row_scale, In column_scale) {
  for (size_t i = 0; i < pattern_.size(); ++i)
    for (int j : pattern_[i]) scaled_(i, j) = row_scale(i) * a(i, j) * column_scale(j);
  for (const Pair& pair : pairs_) {
    double sum = 0.0;
    for (int j : pair.columns) sum += scaled_(pair.a, j) * scaled_(pair.b, j);
    gram_(pair.a, pair.b) = gram_(pair.b, pair.a) = sum;
  }
  mean_ = gram_.trace() / rank_;
  whole_ ? dense() : sparse();
}

void Spectrum::dense() {
  eigen_.compute(gram_, Eigen::EigenvaluesOnly);
  least_ = eigen_.eigenvalues()(gram_.rows() - rank_);
}

void Spectrum::sparse() {
  factor_.compute(gram_);
  least_ = factor_.singular() ? 0.0 : 1.0 / most_of_inverse();
}

// With full orthogonalization, twice, which a few steps can afford; its vector is u_.
double Spectrum::most_of_inverse() {
  along_nothing(u_);
  u_.normalize();
  basis_.col(0) = u_;
  for (int k = 0, look = first;; ++k) {
    factor_.solve(basis_.col(k), next_);
    diagonal_(k) = basis_.col(k).dot(next_);
    const auto known = basis_.leftCols(k + 1);
    for (int twice = 0; twice < 2; ++twice) {
      along_.head(k + 1).noalias() = known.transpose() * next_;
      next_.noalias() -= known * along_.head(k + 1);
    }
    beside_(k) = next_.norm();
    if (ended(k) || k + 1 == look) {
      look *= 2;
      ritz_.computeFromTridiagonal(diagonal_.head(k + 1), beside_.head(k));
      const double value = ritz_.eigenvalues()(k);
      const auto vector = ritz_.eigenvectors().col(k);
      if (ended(k) || beside_(k) * std::abs(vector(k)) <= exact * value) {
        u_.noalias() = known * vector;
        return value;
      }
    }
    basis_.col(k + 1) = next_ / beside_(k);
  }
}

bool Spectrum::ended(int k) const {
  return k + 1 == steps_ || !(beside_(k) > exhausted * std::abs(diagonal_(0)));
}

void Spectrum::vectors(Vector& u, Vector& v) {
  if (whole_) {  // inverse iteration: the shift is as good as the value
    gram_.diagonal().array() -= least_ + 1e-12 * mean_;
    factor_.compute(gram_);
    along_nothing(u_);
    for (int k = 0; k < 2; ++k) {
      factor_.solve(u_, u_);
      u_.normalize();
    }
  }
  u = u_;
  v.noalias() = scaled_.transpose() * u;
}

}  // namespace ckc
