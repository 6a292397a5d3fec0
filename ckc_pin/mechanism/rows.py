"""Primitives of constraint rows: residual phi, constraint Jacobian J and the time derivative of J.

Every loop type is a combination of these six primitives. A primitive holds all rows of its kind and evaluates them
with array operations. It refers to points and directions of the closure's `Anchors` by number, and reads them from a
`Pose` and a `Rate`.

This is the readable reference in NumPy. `native/src/loops` evaluates the same rows in C++, and `codegen/rows.py` as
CasADi expressions.

==============  ===============================================  ==================================
primitive       phi                                              used by
==============  ===============================================  ==================================
`Component`     e . (p_A - p_B), e fixed in a link or the world  point, hinge, prismatic, weld, ...
`Dot`           a . b, two directions fixed in links             hinge, cylindrical, universal
`Distance`      (r . r - L^2) / (2 L), r = p_A - p_B             distance
`Affine`        A q' - c                                         coupling, mimic joint
`Curved`        A q' - c - p(q'_k), a piecewise polynomial p     coupling by a polynomial or a table
`RelativeLog`   log(R_A^T R_B), three rows                       prismatic, weld
==============  ===============================================  ==================================

Rows are implemented three times on purpose: here in NumPy, as the readable reference and for many configurations at
once; in C++ (`native/src`, rows.cpp) for runs; and as CasADi expressions (`codegen/rows.py`) for compiled terms.
`tests/codegen/test_rows_agree.py` compares all three for every type of row.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.mechanism.pose import Pose, Rate, cross, dot_rows
from ckc_pin.mechanism.tree import Tree

__all__ = [
    "Affine",
    "Component",
    "Curved",
    "Distance",
    "Dot",
    "RelativeLog",
    "Rows",
    "log_jacobian",
    "log_jacobian_dot",
    "skew",
]


class Rows(Protocol):
    """A group of constraint rows of one primitive."""

    @property
    def out(self) -> IntArray:
        """Indices of the rows in phi."""

    def in_metres(self, tree: Tree) -> Array | bool:
        """Whether the rows are lengths; other rows are angles or cosines."""

    def phi(self, pose: Pose) -> Array:
        """Residual phi, shape (rows,)."""

    def jacobian(self, pose: Pose) -> Array:
        """Constraint Jacobian, shape (rows, n)."""

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        """Time derivative of the constraint Jacobian at the velocity of `rate`, shape (rows, n)."""


class Component(Immutable, frozen=True):
    """e . r, the component of the difference of two points along a direction.

    `turning` is False if all directions are fixed in the world.
    """

    out: IntArray
    pair: IntArray
    direction: IntArray
    turning: bool

    def in_metres(self, tree: Tree) -> Array | bool:
        return True

    def phi(self, pose: Pose) -> Array:
        return np.sum(pose.e[self.direction] * pose.r[self.pair], axis=1)

    def jacobian(self, pose: Pose) -> Array:
        e = pose.e[self.direction]
        jacobian = pose.project_r_jacobian(self.pair, e)
        if self.turning:  # e_dot . r = (omega x e) . r = omega . (e x r)
            jacobian += pose.project_e_angular(self.direction, cross(e, pose.r[self.pair]))
        return jacobian

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        e = pose.e[self.direction]
        jacobian_dot = dot_rows(e, rate.r_jacobian_dot[self.pair])
        if self.turning:
            r, r_dot, e_dot = pose.r[self.pair], rate.r_dot[self.pair], rate.e_dot[self.direction]
            jacobian_dot += dot_rows(e_dot, pose.r_jacobian[self.pair])
            jacobian_dot += dot_rows(cross(e_dot, r) + cross(e, r_dot), pose.e_angular[self.direction])
            jacobian_dot += dot_rows(cross(e, r), rate.e_angular_dot[self.direction])
        return jacobian_dot


class Dot(Immutable, frozen=True):
    """a . b of two directions, which is zero if they are perpendicular."""

    out: IntArray
    a: IntArray
    b: IntArray

    def in_metres(self, tree: Tree) -> Array | bool:
        return False

    def phi(self, pose: Pose) -> Array:
        return np.sum(pose.e[self.a] * pose.e[self.b], axis=1)

    def jacobian(self, pose: Pose) -> Array:
        # (omega_a x a) . b + a . (omega_b x b) = (omega_a - omega_b) . (a x b)
        normal = cross(pose.e[self.a], pose.e[self.b])
        return pose.project_e_angular(self.a, normal) - pose.project_e_angular(self.b, normal)

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        a, b = pose.e[self.a], pose.e[self.b]
        normal_dot = cross(rate.e_dot[self.a], b) + cross(a, rate.e_dot[self.b])
        return dot_rows(normal_dot, pose.e_angular[self.a] - pose.e_angular[self.b]) + dot_rows(
            cross(a, b), rate.e_angular_dot[self.a] - rate.e_angular_dot[self.b]
        )


class Distance(Immutable, frozen=True):
    """(r . r - L^2) / (2 L), to first order the error of the distance |r| from L, in metres."""

    out: IntArray
    pair: IntArray
    length: Array

    def in_metres(self, tree: Tree) -> Array | bool:
        return True

    def phi(self, pose: Pose) -> Array:
        r = pose.r[self.pair]
        return (np.sum(r * r, axis=1) - self.length**2) / (2 * self.length)

    def jacobian(self, pose: Pose) -> Array:
        return pose.project_r_jacobian(self.pair, pose.r[self.pair] / self.length[:, None])

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        length = self.length[:, None]
        return dot_rows(rate.r_dot[self.pair] / length, pose.r_jacobian[self.pair]) + dot_rows(
            pose.r[self.pair] / length, rate.r_jacobian_dot[self.pair]
        )


class Affine(Immutable, frozen=True):
    """A q' - c, linear in the coordinates of one-freedom joints."""

    out: IntArray
    matrix: Array  # (rows, n)
    offset: Array  # (rows,)

    def in_metres(self, tree: Tree) -> Array | bool:
        return np.any((self.matrix != 0) & tree.in_metres, axis=1)

    def phi(self, pose: Pose) -> Array:
        return self.matrix @ pose.q_tree[pose.tree.q_index] - self.offset

    def jacobian(self, pose: Pose) -> Array:
        return self.matrix

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        return np.zeros_like(self.matrix)


class Curved(Affine, frozen=True):
    """A q' - c - p(q'_k), where p is a piecewise polynomial of one coordinate, which A does not involve."""

    coordinate: IntArray  # (rows,)
    breaks: Array  # (rows, pieces - 1), padded with infinity
    origins: Array  # (rows, pieces)
    coefficients: Array  # (rows, pieces, degree + 1), of the powers of x - origin

    def curve(self, x: Array, order: int) -> Array:
        """Return the derivative of this order of each row's p at coordinates x, (..., rows) each."""
        piece = np.sum(x[..., None] >= self.breaks, axis=-1)
        row = np.arange(len(self.out))
        polynomial = np.moveaxis(self.coefficients[row, piece], -1, 0)
        derivative = np.polynomial.polynomial.polyder(polynomial, order)
        return np.asarray(np.polynomial.polynomial.polyval(x - self.origins[row, piece], derivative, tensor=False))

    def _x(self, pose: Pose) -> Array:
        return pose.q_tree[pose.tree.q_index[self.coordinate]]

    def _scatter(self, values: Array) -> Array:
        matrix = np.zeros_like(self.matrix)
        matrix[np.arange(len(self.out)), self.coordinate] = values
        return matrix

    def phi(self, pose: Pose) -> Array:
        return super().phi(pose) - self.curve(self._x(pose), 0)

    def jacobian(self, pose: Pose) -> Array:
        return self.matrix - self._scatter(self.curve(self._x(pose), 1))

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        return self._scatter(-self.curve(self._x(pose), 2) * rate.v[self.coordinate])


class RelativeLog(Immutable, frozen=True):
    """log(R_A^T R_B), the rotation vector from frame A to frame B: three rows for each pair of frames."""

    out: IntArray  # (3 pairs,)
    joint_a: IntArray
    rotation_a: Array  # (pairs, 3, 3), orientation of frame A in its joint
    joint_b: IntArray
    rotation_b: Array

    def in_metres(self, tree: Tree) -> Array | bool:
        return False

    def _relative(self, pose: Pose) -> tuple[Array, Array, Array]:
        """Return u = log(R_A^T R_B), R_B^T, and the Jacobian of omega_B - omega_A in world axes."""
        r_a = pose.rotation[self.joint_a] @ self.rotation_a
        r_b_transposed = np.swapaxes(pose.rotation[self.joint_b] @ self.rotation_b, 1, 2)
        relative = np.swapaxes(r_b_transposed @ r_a, 1, 2)
        u = np.array([pin.log3(np.ascontiguousarray(r)) for r in relative])
        return u, r_b_transposed, pose.angular(self.joint_b) - pose.angular(self.joint_a)

    def phi(self, pose: Pose) -> Array:
        return self._relative(pose)[0].ravel()

    def jacobian(self, pose: Pose) -> Array:
        u, r_b_transposed, angular = self._relative(pose)
        return (log_jacobian(u) @ r_b_transposed @ angular).reshape(self.out.size, -1)

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        u, r_b_transposed, angular = self._relative(pose)
        body, j_log = r_b_transposed @ angular, log_jacobian(u)
        u_dot = (j_log @ body) @ rate.v
        omega_b = pose.angular(self.joint_b) @ rate.v
        # d/dt (R_B^T X) = R_B^T (X_dot - omega_B x X)
        body_dot = r_b_transposed @ (
            rate.angular_dot(self.joint_b) - rate.angular_dot(self.joint_a) - skew(omega_b) @ angular
        )
        return (log_jacobian_dot(u, u_dot) @ body + j_log @ body_dot).reshape(self.out.size, -1)


# --- logarithm of SO(3) -------------------------------------------------------------------------
#
# u_dot = Jlog(u) omega, omega in body axes. Jlog(u) = 1 + [u]/2 + c [u]^2 is the inverse of the right Jacobian of
# SO(3), with c = 1/theta^2 - cot(theta/2) / (2 theta) and theta = |u|.

# c = sum of |B_2k| / (2k)! theta^(2k - 2). For theta < 1 these terms are enough for double precision.
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330,
              854513 / 138, 236364091 / 2730, 8553103 / 6)  # fmt: skip
_SERIES = [np.array([b / math.factorial(2 * k) for k, b in enumerate(_BERNOULLI, 1)])[::-1]]
FEW_TERMS, SMALL_SQUARE = 3, 1e-4  # of theta^2: below it these terms are enough, as for closed loops
_SERIES.append(2 * np.polyder(_SERIES[0]))  # (dc/dtheta) / theta is twice the derivative by theta^2


def skew(a: Array) -> Array:
    """Return the cross-product matrices of vectors (k, 3), shape (k, 3, 3)."""
    m = np.zeros((len(a), 3, 3))
    m[:, 0, 1], m[:, 0, 2], m[:, 1, 2] = -a[:, 2], a[:, 1], -a[:, 0]
    return m - np.swapaxes(m, 1, 2)


def _coefficients(u: Array, count: int) -> list[Array]:
    """Return c, and if `count` is 2 also (dc/dtheta) / theta, shape (k,) each."""
    square = np.sum(u * u, axis=1)
    if np.all(square < 1.0):
        terms = FEW_TERMS if np.all(square < SMALL_SQUARE) else len(_BERNOULLI)
        return [np.polyval(series[-terms:], square) for series in _SERIES[:count]]
    t = np.where(square < 1.0, 1.0, np.sqrt(square))
    cotangent, sine2 = 1 / np.tan(t / 2), np.sin(t / 2) ** 2
    c = 1 / t**2 - cotangent / (2 * t)
    first = -2 / t**3 + cotangent / (2 * t**2) + 1 / (4 * t * sine2)
    far = (c, first / t)
    each = zip(_SERIES[:count], far, strict=False)
    return [np.where(square < 1.0, np.polyval(series, square), x) for series, x in each]


def log_jacobian(u: Array) -> Array:
    """Return Jlog(u), shape (k, 3, 3)."""
    (c,) = _coefficients(u, 1)
    s = skew(u)
    return np.eye(3) + s / 2 + c[:, None, None] * (s @ s)


def log_jacobian_dot(u: Array, u_dot: Array) -> Array:
    """Return the time derivative of `log_jacobian` at the rate u_dot, shape (k, 3, 3)."""
    c, c_rate = _coefficients(u, 2)
    c_dot = c_rate * np.sum(u * u_dot, axis=1)
    s, s_dot = skew(u), skew(u_dot)
    return s_dot / 2 + c_dot[:, None, None] * (s @ s) + c[:, None, None] * (s_dot @ s + s @ s_dot)
