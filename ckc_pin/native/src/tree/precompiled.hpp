// Precompiled header of all files. It also declares the function templates of Eigen that many files need and that take
// long to compile: tree/eigen_templates.cpp instantiates them once. Without this header, the files compile to the same
// functions in more time. A file does not rely on it: it includes what it uses.
#pragma once

#include <Eigen/Dense>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#ifndef CKC_EIGEN_TEMPLATE
#define CKC_EIGEN_TEMPLATE extern template
#endif

// Member functions that Eigen defines within their classes are missing here: `extern` has no effect on them.
namespace Eigen {

CKC_EIGEN_TEMPLATE JacobiSVD<MatrixXd>& JacobiSVD<MatrixXd>::compute(const MatrixXd&, unsigned int);
CKC_EIGEN_TEMPLATE void ColPivHouseholderQR<MatrixXd>::computeInPlace();
CKC_EIGEN_TEMPLATE void CompleteOrthogonalDecomposition<MatrixXd>::computeInPlace();
CKC_EIGEN_TEMPLATE void CompleteOrthogonalDecomposition<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
CKC_EIGEN_TEMPLATE void PartialPivLU<MatrixXd>::compute();
CKC_EIGEN_TEMPLATE void PartialPivLU<MatrixXcd>::compute();
CKC_EIGEN_TEMPLATE EigenSolver<MatrixXd>& EigenSolver<MatrixXd>::compute(const EigenBase<MatrixXd>&, bool);
CKC_EIGEN_TEMPLATE SelfAdjointEigenSolver<MatrixXd>& SelfAdjointEigenSolver<MatrixXd>::compute(
    const EigenBase<MatrixXd>&, int);
CKC_EIGEN_TEMPLATE SelfAdjointEigenSolver<MatrixXd>& SelfAdjointEigenSolver<MatrixXd>::compute(
    const EigenBase<MatrixXd::IdentityReturnType>&, int);

namespace internal {

CKC_EIGEN_TEMPLATE void apply_block_householder_on_the_left(
    Block<MatrixXd>&, const Block<MatrixXd>&, const VectorBlock<const VectorXd>&, bool);
CKC_EIGEN_TEMPLATE struct triangular_solve_matrix<double, Index, OnTheLeft, Upper, false, ColMajor, ColMajor, 1>;
CKC_EIGEN_TEMPLATE struct triangular_solve_matrix<double, Index, OnTheLeft, UnitLower, false, ColMajor, ColMajor, 1>;
CKC_EIGEN_TEMPLATE struct gebp_kernel<double, double, Index, blas_data_mapper<double, Index, ColMajor, Unaligned, 1>,
                                      gebp_traits<double, double>::mr, gebp_traits<double, double>::nr, false, false>;

}  // namespace internal
}  // namespace Eigen
