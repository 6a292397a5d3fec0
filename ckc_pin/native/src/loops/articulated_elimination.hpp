// Elimination of eq. 1 by articulated bodies, without D': J D'^-1 J^T is computed from one sweep through the tree for
// every eight rows, and factorized.
#pragma once

#include <memory>
#include <vector>

#include "loops/sparse_elimination.hpp"
#include "tree/articulated_bodies.hpp"

namespace ckc {

class ConstraintRows;

class ArticulatedElimination {
 public:
  // `kept`: independent rows of J; the others are left out.
  ArticulatedElimination(const Tree& tree, const ConstraintRows& rows, Indices kept);

  // Number of coordinates that all sweeps visit, and multiplications of the factorization of J D'^-1 J^T.
  long visits() const { return visits_; }
  long operations() const { return operations_; }
  // Factorize, at the bodies' configuration. False if a pivot is so small that digits are lost.
  bool compute(const std::vector<double>& J_entries);
  // As those of SparseElimination.
  void solve(In force, In residual, Out a);
  void solve_unit_forces(const Indices& at, Matrix& columns);

  ArticulatedBodies bodies;

 private:
  template <int size>
  using Block = ArticulatedBodies::Block<size>;
  static constexpr int block_size = ArticulatedBodies::block_size;
  // Rows of J that move the same coordinates, up to eight.
  struct Group {
    Indices rows;         // among the kept ones
    Indices coordinates;  // on which the rows' forces act, and those above them; ascending
    struct Entry {
      int place, source, column;  // of the transposed block, among the entries of J, of J
      double value;
    };
    std::vector<Entry> entries;
    Block<block_size> innovations;  // L^-1 J^T
  };
  // Two groups with common coordinates.
  struct Pair {
    int a, b;
    std::vector<std::pair<int, int>> places;  // of the coordinates in both
    Indices entries;                          // by row of a, then by row of b: index into row_entries_
  };
  template <int size>
  struct Workspace {
    Block<size> x, a, correction;  // x: forces, then sums of L^-1 times forces; (n)
    // (kept rows); magnitudes: sums of the absolute values of all terms of J a + residual
    Block<size> residual, rates, magnitudes;
    void resize(Eigen::Index n, Eigen::Index rows);
  };
  template <int size>
  void solve_block(Workspace<size>& of);
  template <int size>
  void add_row_forces(const Block<size>& rates, Block<size>& x);

  Indices kept_;
  std::vector<Group> groups_;
  std::vector<Pair> pairs_;
  std::unique_ptr<SparseElimination> rows_;
  std::vector<double> row_entries_;  // of the upper triangle of J D'^-1 J^T, by column
  long visits_ = 0, operations_ = 0;
  std::vector<double> inverse_pivots_;  // of a pair's places
  Vector rates_, multipliers_;
  Workspace<1> one_;
  Workspace<block_size> several_;
};

}  // namespace ckc
