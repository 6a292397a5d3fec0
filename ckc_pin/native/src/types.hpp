// Names that every file uses.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <vector>

namespace ckc {

using Vector = Eigen::VectorXd;
using Matrix = Eigen::MatrixXd;
using Vector3 = Eigen::Vector3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix3 = Eigen::Matrix3d;
using Matrix6x = Eigen::Matrix<double, 6, Eigen::Dynamic>;
using Indices = std::vector<int>;
using In = const Eigen::Ref<const Vector>&;
using Out = Eigen::Ref<Vector>;

// Eigen's own compares each number twice and ends at the first, which keeps it from taking several at once.
inline bool finite(In x) {
  double none = 0.0;
  for (Eigen::Index k = 0; k < x.size(); ++k) none += 0.0 * x(k);
  return none == 0.0;
}

}  // namespace ckc
