// Types that every file uses. `In` and `Out` are vector arguments, passed without a copy.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <limits>
#include <vector>

namespace ckc {

using Vector = Eigen::VectorXd;
using Matrix = Eigen::MatrixXd;
using Vector3 = Eigen::Vector3d;
using Vector4 = Eigen::Vector4d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix3 = Eigen::Matrix3d;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Matrix6x = Eigen::Matrix<double, 6, Eigen::Dynamic>;
using Indices = std::vector<int>;
using In = const Eigen::Ref<const Vector>&;
using Out = Eigen::Ref<Vector>;

// Whether all numbers are finite. Eigen's allFinite returns at the first one that is not, which prevents
// vectorization.
inline bool finite(In x) {
  unsigned none = 0;
  for (Eigen::Index k = 0; k < x.size(); ++k) none |= !(std::abs(x(k)) <= std::numeric_limits<double>::max());
  return !none;
}

}  // namespace ckc
