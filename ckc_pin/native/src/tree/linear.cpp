#include "tree/linear.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

namespace ckc {

// Smaller matrices are factorized densely: searching for the nonzero entries would cost more.
constexpr int max_dense_rows = 6;
// Space for the interval of a row, relative to the largest one so far.
constexpr int fill_in_factor = 2;
// Space for rows that the elimination of a column changes, per column.
constexpr int expected_eliminations = 4;

void Factor::set_pattern(int rows, int columns, const std::vector<Indices>& pattern,
                         const std::vector<Indices>& places) {
  rows_ = rows, columns_ = columns, pattern_ = pattern, places_ = places;
  is_small_ = rows == columns && rows <= max_dense_rows;
  Indices first(columns, rows);
  for (int i = rows - 1; i >= 0; --i)
    for (int j : pattern[i]) first[j] = i;
  column_at_.resize(columns), position_of_.resize(columns);
  std::iota(column_at_.begin(), column_at_.end(), 0);
  std::stable_sort(column_at_.begin(), column_at_.end(), [&](int a, int b) { return first[a] < first[b]; });
  for (int k = 0; k < columns; ++k) position_of_[column_at_[k]] = k;
  work_.setZero(std::max(rows, columns));
  if (rows == columns) {
    for (Indices* x : {&row_begin_, &row_end_, &row_capacity_, &row_at_}) x->assign(rows, 0);
    values_.clear(), row_start_.assign(rows, 0);
    eliminated_end_.resize(rows), rows_starting_at_.assign(rows, {});
    eliminated_rows_.reserve(expected_eliminations * rows);
    active_rows_.reserve(rows);
    for (int i = 0; i < rows; ++i) {
      int begin = pattern[i].empty() ? 0 : rows, end = 0;
      for (int j : pattern[i]) begin = std::min(begin, position_of_[j]), end = std::max(end, position_of_[j] + 1);
      if (!pattern[i].empty()) rows_starting_at_[begin].push_back(i);
      if (is_small_) begin = 0, end = rows;
      row_begin_[i] = row_end_[i] = row_capacity_[i] = begin;
      row_start_[i] = static_cast<std::ptrdiff_t>(values_.size()) - begin;
      extend_row(i, end);
    }
  } else {
    qr_.setZero(rows, columns);
    tau_.setZero(columns);
  }
}

// Make space for a longer interval of a row, by moving it behind all others.
void Factor::extend_row(int i, int end) {
  if (end <= row_capacity_[i]) return;
  const int begin = row_begin_[i], capacity = std::min(columns_, begin + fill_in_factor * (end - begin));
  const auto from = static_cast<size_t>(row_start_[i] + begin), to = values_.size();
  values_.resize(to + static_cast<size_t>(capacity - begin), 0.0);
  std::copy_n(values_.begin() + from, row_end_[i] - begin, values_.begin() + to);
  row_start_[i] = static_cast<std::ptrdiff_t>(to) - begin, row_capacity_[i] = capacity;
}

double Factor::pivot(int k) const {
  const int i = row_at_[k];
  return k < row_capacity_[i] && k >= row_begin_[i] ? values_[static_cast<size_t>(row_start_[i] + k)] : 0.0;
}

void Factor::compute(const Matrix& a) {
  if (rows_ != columns_) return qr_ = a, singular_ = false, householder();
  compute_from([&](int i, size_t p) { return a(i, pattern_[i][p]); });
}

void Factor::compute(const std::vector<double>& entries) {
  compute_from([&](int i, size_t p) { return entries[places_[i][p]]; });
}

template <class Entry>
void Factor::compute_from(const Entry& entry) {
  singular_ = false;
  if (rows_ != columns_) {
    qr_.setZero();
    for (int i = 0; i < rows_; ++i)
      for (size_t p = 0; p < pattern_[i].size(); ++p) qr_(i, pattern_[i][p]) = entry(i, p);
    return householder();
  }
  for (int i = 0; i < rows_; ++i) {
    // Clear the fill-in of the previous factorization.
    double* const values = row(i);
    std::fill(values + row_begin_[i], values + (is_small_ ? rows_ : row_end_[i]), 0.0);
    row_end_[i] = row_begin_[i];
    for (size_t p = 0; p < pattern_[i].size(); ++p) {
      const int k = position_of_[pattern_[i][p]];
      values[k] = entry(i, p);
      row_end_[i] = std::max(row_end_[i], k + 1);
    }
  }
  is_small_ ? eliminate_small() : eliminate();
}

void DefiniteFactor::resize(int size) {
  is_small_ = size <= max_dense_rows;
  if (is_small_)
    small_.set_pattern(size, size, full_pattern(size));
  else
    // A solver that has computed nothing cannot be moved, so use it once.
    large_.compute(Matrix::Identity(size, size));
}

void DefiniteFactor::compute(const Matrix& a) { is_small_ ? small_.compute(a) : void(large_.compute(a)); }

void DefiniteFactor::solve(In b, Out x) {
  if (is_small_) return small_.solve(b, x);
  x = b;
  large_.matrixL().solveInPlace(x);
  large_.matrixU().solveInPlace(x);
}

std::vector<Indices> full_pattern(int size) {
  Indices all_columns(size);
  std::iota(all_columns.begin(), all_columns.end(), 0);
  return std::vector<Indices>(size, all_columns);
}

void Factor::eliminate() {
  active_rows_.clear(), eliminated_rows_.clear();
  for (int k = 0; k < rows_; ++k) {
    active_rows_.insert(active_rows_.end(), rows_starting_at_[k].begin(), rows_starting_at_[k].end());
    size_t best = 0;
    double largest = -1.0;
    for (size_t i = 0; i < active_rows_.size(); ++i) {
      const int candidate = active_rows_[i];
      const double size = k < row_end_[candidate] ? std::abs(row(candidate)[k]) : 0.0;
      if (size > largest || std::isnan(size)) largest = size, best = i;
    }
    if (!(largest > 0.0)) singular_ = true;
    if (active_rows_.empty()) {  // structurally singular
      row_at_[k] = k, eliminated_end_[k] = static_cast<int>(eliminated_rows_.size());
      continue;
    }
    const int pivot = active_rows_[best], end = row_end_[pivot];
    active_rows_.erase(active_rows_.begin() + static_cast<std::ptrdiff_t>(best));
    row_at_[k] = pivot;
    for (int i : active_rows_) {
      if (k >= row_end_[i] || row(i)[k] == 0.0) continue;
      extend_row(i, end);
      double* const values = row(i);
      const double* const pivot_values = row(pivot);
      const double factor = values[k] /= pivot_values[k];
      for (int j = k + 1; j < end; ++j) values[j] -= factor * pivot_values[j];
      row_end_[i] = std::max(row_end_[i], end);
      eliminated_rows_.push_back(i);
    }
    eliminated_end_[k] = static_cast<int>(eliminated_rows_.size());
  }
}

void Factor::eliminate_small() {
  const int n = rows_;
  std::iota(row_at_.begin(), row_at_.end(), 0);
  for (int k = 0; k < n; ++k) {
    int best = k;
    double largest = -1.0;
    for (int i = k; i < n; ++i) {
      const double size = std::abs(row(row_at_[i])[k]);
      if (size > largest || std::isnan(size)) largest = size, best = i;
    }
    if (!(largest > 0.0)) singular_ = true;
    std::swap(row_at_[k], row_at_[best]);
    const double* const pivot = row(row_at_[k]);
    for (int i = k + 1; i < n; ++i) {
      double* const values = row(row_at_[i]);
      values[k] /= pivot[k];
      for (int j = k + 1; j < n; ++j) values[j] -= values[k] * pivot[j];
    }
  }
}

double Factor::pivot_ratio() const {
  if (singular_) return 0.0;
  double smallest = std::numeric_limits<double>::infinity(), largest = 0.0;
  for (int k = 0; k < columns_; ++k) {
    const double size = std::abs(rows_ == columns_ ? pivot(k) : qr_(k, k));
    smallest = std::min(smallest, size), largest = std::max(largest, size);
  }
  return columns_ ? smallest / largest : 1.0;
}

void Factor::householder() {
  for (int k = 0; k < columns_; ++k) {
    auto x = qr_.col(k).tail(rows_ - k);
    const double norm = x.norm(), beta = x(0) > 0.0 ? -norm : norm;
    if (!(norm > 0.0)) {
      singular_ = true;
      tau_(k) = 0.0;
      continue;
    }
    tau_(k) = (beta - x(0)) / beta;
    x.tail(rows_ - k - 1) /= x(0) - beta;
    x(0) = beta;
    for (int j = k + 1; j < columns_; ++j) {
      auto y = qr_.col(j).tail(rows_ - k);
      const auto v = x.tail(rows_ - k - 1);
      const double projection = tau_(k) * (y(0) + v.dot(y.tail(rows_ - k - 1)));
      y(0) -= projection;
      y.tail(rows_ - k - 1) -= projection * v;
    }
  }
}

void Factor::solve(In b, Out x) {
  if (rows_ != columns_) {
    work_.head(rows_) = b;
    for (int k = 0; k < columns_; ++k) {
      const auto v = qr_.col(k).tail(rows_ - k - 1);
      const double projection = tau_(k) * (work_(k) + v.dot(work_.segment(k + 1, rows_ - k - 1)));
      work_(k) -= projection;
      work_.segment(k + 1, rows_ - k - 1) -= projection * v;
    }
    for (int k = columns_ - 1; k >= 0; --k) {
      const int remaining = columns_ - k - 1;
      work_(k) = (work_(k) - qr_.row(k).tail(remaining).dot(work_.segment(k + 1, remaining))) / qr_(k, k);
    }
    x = work_.head(columns_);
    return;
  }
  if (is_small_) {
    for (int k = 0; k < rows_; ++k) {
      const double* const values = row(row_at_[k]);
      double value = b(row_at_[k]);
      for (int j = 0; j < k; ++j) value -= values[j] * work_(j);
      work_(k) = value;
    }
    for (int k = rows_ - 1; k >= 0; --k) {
      const double* const values = row(row_at_[k]);
      double value = work_(k);
      for (int j = k + 1; j < rows_; ++j) value -= values[j] * x(column_at_[j]);
      x(column_at_[k]) = value / values[k];
    }
    return;
  }
  work_.head(rows_) = b;
  for (int k = 0, e = 0; k < rows_; ++k) {
    const double value = work_(row_at_[k]);
    for (; e < eliminated_end_[k]; ++e) work_(eliminated_rows_[e]) -= row(eliminated_rows_[e])[k] * value;
  }
  for (int k = rows_ - 1; k >= 0; --k) {
    const int i = row_at_[k];
    const double* const values = row(i);
    double value = work_(i);
    for (int j = k + 1; j < row_end_[i]; ++j) value -= values[j] * x(column_at_[j]);
    x(column_at_[k]) = value / pivot(k);
  }
}

void Factor::solve_transposed(In b, Out x) {
  work_.setZero();
  for (int k = 0; k < columns_; ++k) work_(k) = (b(k) - qr_.col(k).head(k).dot(work_.head(k))) / qr_(k, k);
  for (int k = columns_ - 1; k >= 0; --k) {
    const auto v = qr_.col(k).tail(rows_ - k - 1);
    const double projection = tau_(k) * (work_(k) + v.dot(work_.segment(k + 1, rows_ - k - 1)));
    work_(k) -= projection;
    work_.segment(k + 1, rows_ - k - 1) -= projection * v;
  }
  x = work_.head(rows_);
}

}  // namespace ckc
