#include "loops/partition.hpp"

#include <algorithm>

#include <Eigen/SVD>

namespace ckc {

namespace {

Matrix columns_of(const Matrix& a, const Indices& at) {
  Matrix part(a.rows(), at.size());
  for (size_t k = 0; k < at.size(); ++k) part.col(k) = a.col(at[k]);
  return part;
}

// The first columns that pivoting takes, as they are numbered in `at`.
void take(const Matrix& a, const Indices& at, int count, Indices& z) {
  const Eigen::ColPivHouseholderQR<Matrix> qr(a);
  for (int k = 0; k < count; ++k) z.push_back(at[qr.colsPermutation().indices()(k)]);
}

// A free root's coordinates are dependent as a whole where the loops determine them, else independent as a whole.
bool choose(const Core& core, const Matrix& J, Indices& z) {
  Indices inside, rest;
  std::vector<bool> rooted(core.n, false);
  for (const auto& root : core.tree.roots)
    for (int k = root.v; k < root.v + 6; ++k) rooted[k] = true;
  for (int k = 0; k < core.n; ++k) (rooted[k] ? inside : rest).push_back(k);
  const int within = static_cast<int>(inside.size());
  if (within && within <= std::min<int>(core.rank, static_cast<int>(J.rows()))) {
    const Matrix block = columns_of(J, inside);
    const Eigen::ColPivHouseholderQR<Matrix> qr(block);
    const auto pivots = qr.matrixQR().diagonal().cwiseAbs();
    if (pivots(within - 1) > core.scales.rank * pivots(0)) {
      const Matrix basis = qr.householderQ() * Matrix::Identity(J.rows(), within);
      Matrix left = columns_of(J, rest);
      left -= basis * (basis.transpose() * left);
      z = inside;
      take(left, rest, core.rank - within, z);
      return true;
    }
  }
  const Matrix free = columns_of(J, rest);
  if (within) {
    const Eigen::JacobiSVD<Matrix> svd(free);
    const auto& values = svd.singularValues();
    if (values.size() < core.rank || !(values(core.rank - 1) > core.scales.rank * values(0))) return false;
  }
  take(free, rest, core.rank, z);
  return true;
}

}  // namespace

bool best_partition(Core& core, Partition& found) {
  core.jacobian();
  found = {};
  const Matrix J = core.scales.rows.asDiagonal() * core.rows.J * core.scales.columns.asDiagonal();
  if (core.rank && !choose(core, J, found.z)) return false;
  std::sort(found.z.begin(), found.z.end());
  for (int k = 0; k < core.n; ++k)
    if (!std::binary_search(found.z.begin(), found.z.end(), k)) found.q.push_back(k);
  return true;
}

}  // namespace ckc
