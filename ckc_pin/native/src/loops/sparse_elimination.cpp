#include "loops/sparse_elimination.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace ckc {

// Pivot, relative to the sum that it is left of. The joints near the root of a long chain have small ones: D' contains the
// inertia of the whole chain there. Whether digits are lost that projection keeps is up to EliminationCheck.
constexpr double min_pivot_ratio = 1e-6;

Indices first_entries(const std::vector<Indices>& pattern) {
  Indices first(1, 0);
  for (const Indices& entries : pattern) first.push_back(first.back() + static_cast<int>(entries.size()));
  return first;
}

SparseElimination::SparseElimination(const std::vector<Indices>& inertia_pattern,
                                     const std::vector<Indices>& row_pattern, Indices kept)
    : n_(static_cast<int>(inertia_pattern.size())), kept_(std::move(kept)) {
  const int size = n_ + static_cast<int>(kept_.size());
  std::vector<std::vector<char>> coupled(size, std::vector<char>(size, 0));
  for (int j = 0; j < n_; ++j)
    for (int i : inertia_pattern[j]) coupled[i][j] = coupled[j][i] = 1;
  for (int i = n_; i < size; ++i)
    for (int j : row_pattern[kept_[i - n_]]) coupled[i][j] = coupled[j][i] = 1;
  const Indices order = choose_order(coupled);  // adds fill-in to `coupled`
  place_.resize(size), is_row_.resize(size);
  for (int p = 0; p < size; ++p) place_[order[p]] = p, is_row_[p] = order[p] >= n_;
  Indices value_at(static_cast<size_t>(size) * size, -1);  // (size, size): lower triangle, by column
  for (int p = 0; p < size; ++p) {
    column_start_.push_back(static_cast<int>(place_of_value_.size()));
    for (int i = p; i < size; ++i) {
      if (i != p && !coupled[order[i]][order[p]]) continue;
      value_at[static_cast<size_t>(p) * size + i] = static_cast<int>(place_of_value_.size());
      place_of_value_.push_back(i);
    }
  }
  column_start_.push_back(static_cast<int>(place_of_value_.size()));
  const auto value_of = [&](int i, int j) {
    const auto [first, last] = std::minmax(place_[i], place_[j]);
    return value_at[static_cast<size_t>(first) * size + last];
  };
  int source = 0;
  for (int j = 0; j < n_; ++j)
    for (int i : inertia_pattern[j]) inertia_entries_.push_back({value_of(i, j), source++, place_[i], place_[j], 0.0});
  const Indices first_in_row = first_entries(row_pattern);
  for (int i = n_; i < size; ++i) {
    source = first_in_row[kept_[i - n_]];
    for (int j : row_pattern[kept_[i - n_]])
      jacobian_entries_.push_back({value_of(i, j), source++, place_[i], place_[j], 0.0});
  }
  for (int p = 0; p < size; ++p)  // one update for each pair of entries of a column
    for (int e = column_start_[p]; e < column_start_[p + 1]; ++e) {
      first_run_.push_back(static_cast<int>(runs_.size()));
      operations_ += 4;  // of two substitutions
      if (e == column_start_[p]) continue;
      const auto column = static_cast<size_t>(place_of_value_[e]) * size;
      for (int source = e; source < column_start_[p + 1]; ++source) {
        const int target = value_at[column + place_of_value_[source]];
        if (source > e && target == runs_.back().target + runs_.back().length)
          ++runs_.back().length;
        else
          runs_.push_back({target, source, 1});
        ++operations_;
      }
    }
  first_run_.push_back(static_cast<int>(runs_.size()));
  values_.setZero(place_of_value_.size()), sums_.setZero(size), inverses_.setZero(size);
  solution_.setZero(size), residual_.setZero(size);
}

// Of the unknowns that may be next, take the one that is coupled with the fewest others.
Indices SparseElimination::choose_order(std::vector<std::vector<char>>& coupled) const {
  const int size = static_cast<int>(coupled.size());
  Indices degree(size, 0), waits_for(size, 0), order;
  for (int i = 0; i < size; ++i)
    for (int j = 0; j < size; ++j) {
      degree[i] += i != j && coupled[i][j];
      waits_for[i] += i >= n_ && j < n_ && coupled[i][j];
    }
  const auto original = coupled;
  Indices remaining(size), neighbours;
  std::iota(remaining.rbegin(), remaining.rend(), 0);  // rows first, then from leaves to roots
  while (!remaining.empty()) {
    auto next = remaining.end();
    for (auto at = remaining.begin(); at != remaining.end(); ++at)
      if (!waits_for[*at] && (next == remaining.end() || degree[*at] < degree[*next])) next = at;
    const int k = *next;
    order.push_back(k), remaining.erase(next), neighbours.clear();
    for (int i : remaining)
      if (coupled[k][i]) neighbours.push_back(i), --degree[i], waits_for[i] -= k < n_ && i >= n_ && original[k][i];
    for (int i : neighbours)
      for (int j : neighbours)
        if (i != j && !coupled[i][j]) coupled[i][j] = 1, ++degree[i];
  }
  return order;
}

bool SparseElimination::compute(const std::vector<double>& D_entries, const std::vector<double>& J_entries) {
  values_.setZero(), sums_.setZero();
  for (Entry& entry : inertia_entries_) {
    values_(entry.index) = entry.value = D_entries[static_cast<size_t>(entry.source)];
    if (entry.place_of_row == entry.place_of_column) sums_(entry.place_of_row) = entry.value;
  }
  for (Entry& entry : jacobian_entries_)
    values_(entry.index) = entry.value = J_entries[static_cast<size_t>(entry.source)];
  const int size = static_cast<int>(place_.size());
  double* const values = values_.data();
  for (int p = 0; p < size; ++p) {
    const int first = column_start_[p], last = column_start_[p + 1];
    const double pivot = values[first], magnitude = is_row_[p] ? -pivot : pivot;
    if (!(magnitude > min_pivot_ratio * sums_(p))) return false;
    const double inverse = inverses_(p) = 1.0 / pivot;
    for (int e = first + 1; e < last; ++e) {
      const double factor = values[e] * inverse;
      const int place = place_of_value_[e];
      if (is_row_[p] != is_row_[place]) sums_(place) += std::abs(factor * values[e]);
      for (int r = first_run_[e]; r < first_run_[e + 1]; ++r) {
        const Run& run = runs_[r];
        double* __restrict const target = values + run.target;  // of another column than the source
        const double* __restrict const source = values + run.source;
        for (int i = 0; i < run.length; ++i) target[i] -= factor * source[i];
      }
    }
    for (int e = first + 1; e < last; ++e) values[e] *= inverse;
  }
  return true;
}

template <class Unknowns>
void SparseElimination::substitute(Unknowns& x) const {
  const int size = static_cast<int>(place_.size());
  for (int p = 0; p < size; ++p)
    for (int e = column_start_[p] + 1; e < column_start_[p + 1]; ++e) x.row(place_of_value_[e]) -= values_(e) * x.row(p);
  for (int p = size - 1; p >= 0; --p) {
    x.row(p) *= inverses_(p);
    for (int e = column_start_[p] + 1; e < column_start_[p + 1]; ++e) x.row(p) -= values_(e) * x.row(place_of_value_[e]);
  }
}

// Solution, and its refinement into `residual`, which contains the right-hand sides before.
template <class Unknowns>
void SparseElimination::solve_refined(Unknowns& solution, Unknowns& residual) const {
  solution = residual;
  substitute(solution);
  for (const std::vector<Entry>* entries : {&inertia_entries_, &jacobian_entries_})
    for (const Entry& entry : *entries) {
      residual.row(entry.place_of_row) -= entry.value * solution.row(entry.place_of_column);
      if (entry.place_of_row != entry.place_of_column)
        residual.row(entry.place_of_column) -= entry.value * solution.row(entry.place_of_row);
    }
  substitute(residual);
}

void SparseElimination::solve(In force, In residual, Out a) {
  for (int k = 0; k < n_; ++k) residual_(place_[k]) = force(k);
  for (size_t i = 0; i < kept_.size(); ++i) residual_(place_[static_cast<size_t>(n_) + i]) = -residual(kept_[i]);
  solve_refined(solution_, residual_);
  for (int k = 0; k < n_; ++k) a(k) = solution_(place_[k]) + residual_(place_[k]);
}

void SparseElimination::solve_without_rows(In force, Out a) {
  for (int k = 0; k < n_; ++k) solution_(place_[k]) = force(k);
  substitute(solution_);
  for (int k = 0; k < n_; ++k) a(k) = solution_(place_[k]);
}

void SparseElimination::solve_unit_forces(const Indices& at, Matrix& columns) {
  solutions_.resize(solution_.size(), block_size), residuals_.resize(solution_.size(), block_size);
  const int count = static_cast<int>(at.size());
  for (int first = 0; first < count; first += block_size) {
    const int last = std::min(first + block_size, count);
    residuals_.setZero();
    for (int j = first; j < last; ++j) residuals_(place_[at[j]], j - first) = 1.0;
    solve_refined(solutions_, residuals_);
    for (int j = first; j < last; ++j)
      for (int k = 0; k < n_; ++k) columns(k, j) = solutions_(place_[k], j - first) + residuals_(place_[k], j - first);
  }
}

}  // namespace ckc
