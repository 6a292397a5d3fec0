// Inertia of a rigid body, or of several that move as one.
#pragma once

#include "tree/types.hpp"
#include "tree/widest_registers.hpp"

namespace ckc {

// About a reference point: bodies are then added entry by entry.
struct RigidBody {
  double mass;
  double moment[4];      // mass times centre of mass, 0
  double inertia[3][4];  // rows, about the reference point
};

// `centre` of mass from the reference point.
ALWAYS_INLINE RigidBody rigid_body(double m, const Vector3& centre, const Matrix3& about_centre) {
  const double x = centre.x(), y = centre.y(), z = centre.z();
  const double xx = about_centre(0, 0) + m * (y * y + z * z), xy = about_centre(0, 1) - m * x * y,
               yy = about_centre(1, 1) + m * (x * x + z * z), xz = about_centre(0, 2) - m * x * z,
               zz = about_centre(2, 2) + m * (x * x + y * y), yz = about_centre(1, 2) - m * y * z;
  return {m, {m * x, m * y, m * z, 0.0}, {{xx, xy, xz, 0.0}, {xy, yy, yz, 0.0}, {xz, yz, zz, 0.0}}};
}

ALWAYS_INLINE Vector3 moment_of(const RigidBody& body) { return {body.moment[0], body.moment[1], body.moment[2]}; }

ALWAYS_INLINE Vector3 momentum(const RigidBody& body, const Vector3& velocity, const Vector3& omega) {
  return body.mass * velocity + omega.cross(moment_of(body));
}

ALWAYS_INLINE Vector3 angular_momentum(const RigidBody& body, const Vector3& velocity, const Vector3& omega) {
  Vector3 turning;
  for (int i = 0; i < 3; ++i)
    turning(i) = body.inertia[i][0] * omega(0) + body.inertia[i][1] * omega(1) + body.inertia[i][2] * omega(2);
  return moment_of(body).cross(velocity) + turning;
}

ALWAYS_INLINE void add(const RigidBody& term, RigidBody& sum) {
  sum.mass += term.mass;
  for (int i = 0; i < 4; ++i) sum.moment[i] += term.moment[i];
  for (int c = 0; c < 3; ++c)
    for (int i = 0; i < 4; ++i) sum.inertia[c][i] += term.inertia[c][i];
}

}  // namespace ckc
