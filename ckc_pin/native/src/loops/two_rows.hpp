// The smallest singular value of a matrix of two rows, as the loop closure of one planar loop has it.
//
// A number is a double, or a vector of numbers of several mechanisms (`Vector8`).
#pragma once

#include <cmath>

#include "tree/widest_registers.hpp"

namespace ckc {

inline void take_root(double& x) { x = std::sqrt(x); }
inline void take_root(Vector8& x) {
  for (int k = 0; k < 8; ++k) x[k] = std::sqrt(x[k]);
}

// Smallest eigenvalue of the symmetric matrix with the diagonal a, b and the entry c beside it.
template <class Number>
ALWAYS_INLINE void find_smallest_eigenvalue(const Number& a, const Number& b, const Number& c, Number& smallest) {
  const Number difference = 0.5 * (a - b);
  Number root = difference * difference + c * c;
  take_root(root);
  smallest = 0.5 * (a + b) - root;
}

// Of the scaled J (2, columns), stored by columns: the smallest singular value over the root mean square of both, and
// its rate.
template <class Number>
ALWAYS_INLINE void find_rank_of_two_rows(const Number* J, const Number* J_dot, const double* row_scales,
                                         const double* column_scales, int columns, Number& value, Number& rate) {
  Number a = {}, b = {}, c = {};  // J J^T
  for (int j = 0; j < columns; ++j) {
    const Number x = row_scales[0] * J[2 * j] * column_scales[j], y = row_scales[1] * J[2 * j + 1] * column_scales[j];
    a += x * x, b += y * y, c += x * y;
  }
  Number smallest;
  find_smallest_eigenvalue(a, b, c, smallest);
  // The eigenvector: the longer of the two rows of J J^T - smallest, turned by a right angle.
  const Number zero = {}, one = zero + 1.0, from_a = a - smallest, from_b = b - smallest;
  Number u_0 = from_a > from_b ? -c : from_b, u_1 = from_a > from_b ? from_a : -c;
  Number length = u_0 * u_0 + u_1 * u_1;
  take_root(length);
  const auto exists = from_a + from_b > zero;
  u_0 = exists ? u_0 / length : one, u_1 = exists ? u_1 / length : zero;
  Number square = {}, sum = {};  // of v = J^T u, and of u^T J_dot v
  for (int j = 0; j < columns; ++j) {
    const Number x = row_scales[0] * J[2 * j] * column_scales[j], y = row_scales[1] * J[2 * j + 1] * column_scales[j];
    const Number v = x * u_0 + y * u_1;
    square += v * v;
    sum += (row_scales[0] * J_dot[2 * j] * u_0 + row_scales[1] * J_dot[2 * j + 1] * u_1) * (v * column_scales[j]);
  }
  take_root(square);
  Number mean = 0.5 * (a + b);
  take_root(mean);
  const Number tiny = zero + 1e-300;
  value = square / mean, rate = sum / (square > tiny ? square : tiny) / mean;
}

}  // namespace ckc
