// Rotation vectors: by which matrix they move, and how that matrix changes.
#pragma once

#include "tree/types.hpp"

namespace ckc {

inline Matrix3 skew(const Vector3& a) {
  Matrix3 m;
  m << 0, -a(2), a(1), a(2), 0, -a(0), -a(1), a(0), 0;
  return m;
}

// u_dot = Jlog(u) omega, omega in the turned axes: Jlog(u) = 1 + [u]/2 + c(|u|) [u]^2.
class LogRate {
 public:
  explicit LogRate(const Vector3& u);
  Matrix3 value;
  Matrix3 along(const Vector3& a) const;                    // its derivative along a
  Matrix3 along(const Vector3& a, const Vector3& b) const;  // and of that along b

 private:
  Vector3 u_;
  Matrix3 s_;
  double c_, c_rate_, c_curve_;  // c, then each divided derivative: c'(x)/x, and of that once more
};

}  // namespace ckc
