// The Jacobian of the rotation vector (logarithm of SO(3)) and its derivatives.
#pragma once

#include "tree/types.hpp"

namespace ckc {

inline Matrix3 skew(const Vector3& a) {
  Matrix3 m;
  m << 0, -a(2), a(1), a(2), 0, -a(0), -a(1), a(0), 0;
  return m;
}

// Jlog(u) with u_dot = Jlog(u) omega, where omega is in the rotated axes: Jlog(u) = 1 + [u]/2 + c(|u|) [u]^2.
class LogJacobian {
 public:
  explicit LogJacobian(const Vector3& u);
  Matrix3 value;
  Matrix3 derivative(const Vector3& a) const;                           // directional derivative along a
  Matrix3 second_derivative(const Vector3& a, const Vector3& b) const;  // along a, then b

 private:
  Vector3 u_;
  Matrix3 s_;
  double c_, c_rate_, c_second_;  // c(x), b(x) = c'(x)/x, and b'(x)/x, with x = |u|
};

}  // namespace ckc
