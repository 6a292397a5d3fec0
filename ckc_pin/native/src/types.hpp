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

}  // namespace ckc
