#include "loops/partition.hpp"

#include <algorithm>

#include <Eigen/SVD>

namespace ckc {

constexpr double min_exchange_factor = 1.5;  // of |det phi_z|

namespace {

Matrix columns_of(const Matrix& a, const Indices& at) {
  Matrix part(a.rows(), at.size());
  for (size_t k = 0; k < at.size(); ++k) part.col(k) = a.col(at[k]);
  return part;
}

// Append the coordinates `at` of the first `count` columns that pivoting selects.
void append_pivot_columns(const Matrix& a, const Indices& at, int count, Indices& z) {
  const Eigen::ColPivHouseholderQR<Matrix> qr(a);
  for (int k = 0; k < count; ++k) z.push_back(at[qr.colsPermutation().indices()(k)]);
}

// The coordinates of a free root are dependent as a whole if the loops determine them, else independent as a whole.
bool choose_dependent(const Core& core, const Matrix& J, Indices& z) {
  Indices root_coordinates, other_coordinates;
  std::vector<bool> is_root(core.n, false);
  for (const auto& root : core.tree.roots)
    for (int k = root.v; k < root.v + 6; ++k) is_root[k] = true;
  for (int k = 0; k < core.n; ++k) (is_root[k] ? root_coordinates : other_coordinates).push_back(k);
  const int root_count = static_cast<int>(root_coordinates.size());
  if (root_count && root_count <= std::min<int>(core.rank, static_cast<int>(J.rows()))) {
    const Matrix block = columns_of(J, root_coordinates);
    const Eigen::ColPivHouseholderQR<Matrix> qr(block);
    const auto pivots = qr.matrixQR().diagonal().cwiseAbs();
    if (pivots(root_count - 1) > core.scales.rank * pivots(0)) {
      const Matrix basis = qr.householderQ() * Matrix::Identity(J.rows(), root_count);
      Matrix projected = columns_of(J, other_coordinates);
      projected -= basis * (basis.transpose() * projected);
      z = root_coordinates;
      append_pivot_columns(projected, other_coordinates, core.rank - root_count, z);
      return true;
    }
  }
  const Matrix free = columns_of(J, other_coordinates);
  if (root_count) {
    const Eigen::JacobiSVD<Matrix> svd(free);
    const auto& values = svd.singularValues();
    if (values.size() < core.rank || !(values(core.rank - 1) > core.scales.rank * values(0))) return false;
  }
  append_pivot_columns(free, other_coordinates, core.rank, z);
  return true;
}

}  // namespace

// Exchange a dependent coordinate for an independent one while this multiplies |det phi_z| enough. Needs only rho: its
// entry of both coordinates, dimensionless, is the factor.
static void exchange_coordinates(Core& core, Partition& best) {
  core.compute_rho();
  best = {core.q, core.z};
  Matrix rho = core.scales.columns.cwiseInverse().asDiagonal() * core.rho;
  for (int k = 0; k < core.d; ++k) rho.col(k) *= core.scales.columns(best.q[k]);
  for (int exchanges = 0; exchanges < core.n; ++exchanges) {
    double largest = min_exchange_factor;
    size_t dependent = 0;
    int independent = -1;
    for (int k = 0; k < core.d; ++k)
      for (size_t i = 0; i < best.z.size(); ++i)
        if (std::abs(rho(best.z[i], k)) > largest) largest = std::abs(rho(best.z[i], k)), dependent = i, independent = k;
    if (independent < 0) return;
    rho.col(independent) /= rho(best.z[dependent], independent);
    for (int k = 0; k < core.d; ++k)
      if (k != independent) rho.col(k) -= rho(best.z[dependent], k) * rho.col(independent);
    std::swap(best.z[dependent], best.q[independent]);
  }
}

bool find_best_partition(Core& core, Partition& best) {
  if (core.n > max_pivoted_size && core.tree.roots.empty()) {
    exchange_coordinates(core, best);
    if (best.q != core.q) std::sort(best.q.begin(), best.q.end()), std::sort(best.z.begin(), best.z.end());
    return true;
  }
  core.compute_J();
  best = {};
  const Matrix J = core.scales.rows.asDiagonal() * core.constraints.J() * core.scales.columns.asDiagonal();
  if (core.rank && !choose_dependent(core, J, best.z)) return false;
  std::sort(best.z.begin(), best.z.end());
  for (int k = 0; k < core.n; ++k)
    if (!std::binary_search(best.z.begin(), best.z.end(), k)) best.q.push_back(k);
  return true;
}

}  // namespace ckc
