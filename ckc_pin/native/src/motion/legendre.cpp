#include "motion/legendre.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

Matrix legendre_values(const Vector& x, Eigen::Index count) {
  Matrix values(count, x.size());
  values.row(0).setOnes();
  if (count > 1) values.row(1) = x.transpose();
  for (Eigen::Index k = 1; k + 1 < count; ++k)
    values.row(k + 1) =
        (static_cast<double>(2 * k + 1) * values.row(k).cwiseProduct(x.transpose()) - k * values.row(k - 1)) / (k + 1);
  return values;
}

// P_k' = sum of (2 j + 1) P_j over j = k - 1, k - 3, ...
Matrix legendre_derivative_matrix(Eigen::Index degree) {
  Matrix derivative_matrix = Matrix::Zero(degree + 1, degree);
  for (Eigen::Index k = 1; k <= degree; ++k)
    for (Eigen::Index j = k - 1; j >= 0; j -= 2) derivative_matrix(k, j) = static_cast<double>(2 * j + 1);
  return derivative_matrix;
}

// Zeros of P_s + b P_(s - 1) by Newton's method, starting between the extrema of a cosine.
static Vector zeros(int s, double b) {
  Vector x(s), series = Vector::Zero(s + 1);
  series(s) = 1.0, series(s - 1) = b;
  const Vector slope = legendre_derivative_matrix(s).transpose() * series;
  for (int k = 0; k < s; ++k) {
    const double angle = b == 0.0 ? (k + 0.75) / (s + 0.5) : (2.0 * k) / (2.0 * s - 1.0);
    x(k) = std::cos(M_PI * angle);
    for (int i = 0; i < 50; ++i) {
      const Vector at = legendre_values(Vector::Constant(1, x(k)), s + 1);
      const double step = series.dot(at) / slope.dot(at.head(s));
      x(k) -= step;
      if (std::abs(step) < 1e-16) break;
    }
  }
  std::sort(x.begin(), x.end());
  return x;
}

Vector gauss_nodes(int s) { return zeros(s, 0.0); }

Vector radau_nodes(int s) {
  Vector x = zeros(s, -1.0);
  x(s - 1) = 1.0;
  return x;
}

}  // namespace ckc
