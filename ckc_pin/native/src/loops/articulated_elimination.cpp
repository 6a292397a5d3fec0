#include "loops/articulated_elimination.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>

#include "loops/rows.hpp"
#include "tree/widest_registers.hpp"

namespace ckc {

constexpr int block_size = ArticulatedBodies::block_size;
using Places = std::vector<std::pair<int, int>>;
// A residual of up to this, relative to the sum of the magnitudes of a row's terms, is rounding, which a refinement
// cannot reduce.
constexpr double max_residual = 2 * std::numeric_limits<double>::epsilon();

static const Vector8& row_of(const double* block, int place) {
  return *reinterpret_cast<const Vector8*>(block + static_cast<ptrdiff_t>(place) * block_size);
}

// Products of columns of L^-1 J^T of two groups of rows, divided by the pivots of the coordinates at these places.
WITH_WIDEST_REGISTERS static void multiply_innovations(const double* a, const double* b, const Places& places,
                                                       const double* inverse_pivots, int rows, double* products) {
  Vector8 sums[block_size] = {};
  for (size_t k = 0; k < places.size(); ++k) {
    const double* const row = a + static_cast<ptrdiff_t>(places[k].first) * block_size;
    for (int i = 0; i < rows; ++i) sums[i] += row_of(b, places[k].second) * (row[i] * inverse_pivots[k]);
  }
  for (int i = 0; i < rows; ++i) reinterpret_cast<Vector8*>(products)[i] = sums[i];
}

ArticulatedElimination::ArticulatedElimination(const Tree& tree, const ConstraintRows& rows, Indices kept)
    : bodies(tree), kept_(std::move(kept)) {
  const int count = static_cast<int>(kept_.size());
  const Indices first_in_row = first_entries(rows.pattern);
  std::map<Indices, Indices> rows_by_coordinates;
  for (int i = 0; i < count; ++i) {
    std::set<int> moved;
    for (int j : rows.pattern[kept_[i]]) moved.insert(tree.ancestors[j].begin(), tree.ancestors[j].end());
    rows_by_coordinates[Indices(moved.begin(), moved.end())].push_back(i);
  }
  for (const auto& [coordinates, of] : rows_by_coordinates)
    for (size_t first = 0; first < of.size(); first += block_size) {
      Group group;
      group.rows.assign(of.begin() + first, of.begin() + std::min(first + block_size, of.size()));
      group.coordinates = coordinates;
      for (size_t l = 0; l < group.rows.size(); ++l) {
        const int row = kept_[group.rows[l]];
        int source = first_in_row[row];
        for (int j : rows.pattern[row]) {
          const auto place = std::lower_bound(coordinates.begin(), coordinates.end(), j) - coordinates.begin();
          group.entries.push_back({static_cast<int>(place * block_size + l), source++, j, 0.0});
        }
      }
      group.innovations.resize(static_cast<Eigen::Index>(coordinates.size()), block_size);
      visits_ += static_cast<long>(coordinates.size());
      groups_.push_back(std::move(group));
    }
  std::vector<Indices> pattern(count);
  for (int a = 0; a < static_cast<int>(groups_.size()); ++a)
    for (int b = a; b < static_cast<int>(groups_.size()); ++b) {
      Pair pair{a, b, {}, {}};
      const Indices &of_a = groups_[a].coordinates, &of_b = groups_[b].coordinates;
      for (size_t i = 0, j = 0; i < of_a.size() && j < of_b.size();) {
        if (of_a[i] == of_b[j]) pair.places.emplace_back(i, j);
        const bool advance_a = of_a[i] <= of_b[j], advance_b = of_b[j] <= of_a[i];
        i += advance_a, j += advance_b;
      }
      if (pair.places.empty()) continue;
      visits_ += static_cast<long>(pair.places.size());
      for (int i : groups_[a].rows)
        for (int j : groups_[b].rows)
          if (a != b || i <= j) pattern[std::max(i, j)].push_back(std::min(i, j));
      pairs_.push_back(std::move(pair));
    }
  for (Indices& column : pattern) std::sort(column.begin(), column.end());
  const Indices first_in_column = first_entries(pattern);
  for (Pair& pair : pairs_)
    for (int i : groups_[pair.a].rows)
      for (int j : groups_[pair.b].rows) {
        const Indices& column = pattern[std::max(i, j)];
        const auto place = std::lower_bound(column.begin(), column.end(), std::min(i, j)) - column.begin();
        pair.entries.push_back(first_in_column[std::max(i, j)] + static_cast<int>(place));
      }
  row_entries_.resize(first_in_column.back());
  rows_ = std::make_unique<SparseElimination>(pattern, std::vector<Indices>(), Indices());
  operations_ = rows_->operations();
  inverse_pivots_.resize(tree.n);
  rates_.setZero(count), multipliers_.setZero(count), one_.resize(tree.n, count);
}

bool ArticulatedElimination::compute(const std::vector<double>& J_entries) {
  if (!bodies.factorize()) return false;
  for (Group& group : groups_) {
    group.innovations.setZero();
    double* const innovations = group.innovations.data();
    for (Group::Entry& entry : group.entries)
      innovations[entry.place] = entry.value = J_entries[static_cast<size_t>(entry.source)];
    bodies.eliminate(group.coordinates, group.innovations);
  }
  for (const Pair& pair : pairs_) {
    const Group &a = groups_[pair.a], &b = groups_[pair.b];
    const auto rows = static_cast<int>(a.rows.size()), columns = static_cast<int>(b.rows.size());
    for (size_t k = 0; k < pair.places.size(); ++k)
      inverse_pivots_[k] = bodies.inverse_pivot(a.coordinates[pair.places[k].first]);
    double products[block_size][block_size];
    multiply_innovations(a.innovations.data(), b.innovations.data(), pair.places, inverse_pivots_.data(), rows, products[0]);
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < columns; ++j) row_entries_[pair.entries[i * columns + j]] = products[i][j];
  }
  return rows_->compute(row_entries_, {});
}

// x += L^-1 J^T lambda, with the multipliers lambda that change the accelerations of the rows by `rates`.
template <int size>
void ArticulatedElimination::add_row_forces(const Block<size>& rates, Block<size>& x) {
  for (int l = 0; l < size; ++l) {
    rates_ = rates.col(l);
    rows_->solve_without_rows(rates_, multipliers_);
    for (const Group& group : groups_) {
      double multipliers[block_size] = {};
      for (size_t i = 0; i < group.rows.size(); ++i) multipliers[i] = multipliers_(group.rows[i]);
      for (size_t place = 0; place < group.coordinates.size(); ++place) {
        const Vector8 products = row_of(group.innovations.data(), static_cast<int>(place)) * row_of(multipliers, 0);
        x(group.coordinates[place], l) += ((products[0] + products[1]) + (products[2] + products[3])) +
                                          ((products[4] + products[5]) + (products[6] + products[7]));
      }
    }
  }
}

template <int size>
void ArticulatedElimination::Workspace<size>::resize(Eigen::Index n, Eigen::Index rows) {
  for (Block<size>* vectors : {&x, &a, &correction}) vectors->setZero(n, size);
  for (Block<size>* vectors : {&residual, &rates, &magnitudes}) vectors->setZero(rows, size);
}

// Solve for the forces x, with J a = -residual. J D'^-1 J^T has the square of J's condition number, therefore the solution
// is refined once, unless J a differs from -residual by no more than its own rounding.
template <int size>
void ArticulatedElimination::solve_block(Workspace<size>& of) {
  auto& [x, a, correction, residual, rates, magnitudes] = of;
  bodies.eliminate(bodies.all(), x);
  rates = -residual;
  for (const Group& group : groups_)
    for (int l = 0; l < size; ++l) {
      Vector8 sums = {};
      for (size_t place = 0; place < group.coordinates.size(); ++place) {
        const int k = group.coordinates[place];
        sums += row_of(group.innovations.data(), static_cast<int>(place)) * (bodies.inverse_pivot(k) * x(k, l));
      }
      for (size_t i = 0; i < group.rows.size(); ++i) rates(group.rows[i], l) -= sums[i];
    }
  add_row_forces(rates, x);
  bodies.accelerate(x, a);
  rates = -residual, magnitudes = residual.cwiseAbs();
  for (const Group& group : groups_)
    for (const Group::Entry& entry : group.entries) {
      const int row = group.rows[static_cast<size_t>(entry.place % block_size)];
      for (int l = 0; l < size; ++l) {
        const double term = entry.value * a(entry.column, l);
        rates(row, l) -= term, magnitudes(row, l) += std::abs(term);
      }
    }
  if ((rates.array().abs() <= max_residual * magnitudes.array()).all()) return;
  x.setZero();
  add_row_forces(rates, x);
  bodies.accelerate(x, correction);
  a += correction;
}

void ArticulatedElimination::solve(In force, In residual, Out a) {
  one_.x = force;
  for (size_t i = 0; i < kept_.size(); ++i) one_.residual(static_cast<Eigen::Index>(i)) = residual(kept_[i]);
  solve_block(one_);
  a = one_.a;
}

void ArticulatedElimination::solve_unit_forces(const Indices& at, Matrix& columns) {
  const int count = static_cast<int>(at.size());
  several_.resize(columns.rows(), static_cast<Eigen::Index>(kept_.size()));
  for (int first = 0; first < count; first += block_size) {
    const int last = std::min(first + block_size, count);
    several_.x.setZero();
    for (int j = first; j < last; ++j) several_.x(at[j], j - first) = 1.0;
    solve_block(several_);
    columns.middleCols(first, last - first) = several_.a.leftCols(last - first);
  }
}

}  // namespace ckc
