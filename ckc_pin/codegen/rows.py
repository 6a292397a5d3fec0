"""Constraint rows as CasADi expressions: phi, J and J_dot v.

Constraint rows are implemented three times, from the same primitives of `mechanism.rows`: in NumPy
(`mechanism/rows.py`), as the readable reference and for batches of configurations; in C++
(`native/src/loops/rows.cpp`), for runs; and here, because compiled terms need expressions that CasADi can differentiate
and simplify for one mechanism.
`tests/codegen/test_rows_agree.py` compares all three for every row type.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.arguments import Arguments, constant
from ckc_pin.codegen.bodies import ConfigurationSymbols, MovingBody, cross, dot, multiply
from ckc_pin.codegen.branches import BranchAxes
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.rows import Affine, Component, Curved, Distance, Dot, RelativeLog

__all__ = ["RowTerms", "row_terms"]

SERIES_SIN_SQUARED = 0.0025  # rad^2, sin^2 of the angle below which the logarithm is evaluated as a series


@dataclass(frozen=True)
class RowTerms:
    """phi (rows), J (rows, n) and J_dot v (rows)."""

    phi: Any
    J: Any
    J_dot_v: Any


@dataclass(frozen=True)
class _MovingVector:
    """A vector, its rate, its acceleration at dv'/dt = 0, and its Jacobian with respect to v', (3, n)."""

    value: Any
    rate: Any
    acceleration: Any
    jacobian: Any

    def __sub__(self, other: _MovingVector) -> _MovingVector:
        return _MovingVector(
            self.value - other.value,
            self.rate - other.rate,
            self.acceleration - other.acceleration,
            self.jacobian - other.jacobian,
        )

    def rotated(self, R: Any) -> _MovingVector:
        """Return the vector in other axes at rest."""
        return _MovingVector(*(multiply(R, x) for x in (self.value, self.rate, self.acceleration, self.jacobian)))


@dataclass(frozen=True)
class _Point:
    """A point of a body, `local` in the body's frame, and its motion in the axes of the body's branch."""

    body: MovingBody
    local: Any
    motion: _MovingVector

    def motion_in(self, axes: BranchAxes) -> _MovingVector:
        """Return the motion in other axes at rest."""
        return self.motion.rotated(self.body.axes.rotation_to(axes))

    def motion_from(self, other: _Point, axes: BranchAxes) -> _MovingVector:
        """Return the motion of the vector from another point to this one, in axes at rest."""
        return self.motion_in(axes) - other.motion_in(axes)

    def motion_in_frame(self, body: MovingBody, n: int, sign: int) -> _MovingVector:
        """Return the motion of the point in a body's moving frame, times `sign`."""
        import casadi as cs

        here = self.motion_in(body.axes)

        def subtract(x: Any, y: Any) -> Any:
            return x - y if sign > 0 else y - x

        lever = subtract(here.value, body.origin)
        swept = cross(body.omega, lever)
        rate = subtract(here.rate, body.velocity) - swept
        acceleration = subtract(here.acceleration, body.acceleration) - cross(body.alpha, lever)
        acceleration = acceleration - cross(body.omega, swept + 2 * rate)
        value, rate, acceleration = (multiply(body.R.T, x) for x in (lever, rate, acceleration))
        R = self.body.axes.rotation_to(body.axes)
        carried = multiply(R, self.body.carried_jacobian(self.motion.value, n))
        carried = multiply(body.R.T, subtract(carried, body.carried_jacobian(here.value, n)))
        own_columns = self.body.own_jacobian(multiply(body.R.T, multiply(R, self.body.R)), self.local, n)
        jacobian = carried + sign * own_columns - sign * body.own_jacobian(cs.SX.eye(3), sign * value, n)
        return _MovingVector(value, rate, acceleration, jacobian)


def row_terms(
    closure: Closure,
    bodies: Sequence[MovingBody],
    configuration: ConfigurationSymbols,
    v: Any,
    q_dot: Any,
    place: Sequence[int],
    arguments: Arguments,
) -> RowTerms:
    """Return the expressions of a closure's rows.

    Parameters
    ----------
    closure : Closure
    bodies : sequence of MovingBody
    configuration : ConfigurationSymbols
        Pinocchio's q'.
    v, q_dot : casadi.SX
        v', and the rate of q' at it.
    place : sequence of int
        Indices in q' of the coordinates of one-freedom joints.
    arguments : Arguments
        Symbols of the frames' offsets, lengths of rods, ratios and offsets of couplings.
    """
    import casadi as cs

    n = v.numel()
    anchors = closure.anchors
    points = [_point(bodies[joint], arguments.column("point", k), n) for k, joint in enumerate(anchors.point_joint)]
    pairs = list(zip(points[: len(points) // 2], points[len(points) // 2 :], strict=True))
    directions = [
        (bodies[joint], constant(local))
        for joint, local in zip(anchors.direction_joint, anchors.direction_local, strict=True)
    ]
    phi, J, J_dot_v = cs.SX(closure.rows, 1), cs.SX(closure.rows, n), cs.SX(closure.rows, 1)

    def put(out: int, row: tuple[Any, Any, Any]) -> None:
        phi[out], J[out, :], J_dot_v[out] = row

    for group in closure.groups:
        match group:
            case Component():
                for out, pair, direction in zip(group.out, group.pair, group.direction, strict=True):
                    a, b = pairs[pair]
                    put(int(out), _component(directions[direction], a, b, n))
            case Dot():
                for out, a, b in zip(group.out, group.a, group.b, strict=True):
                    put(int(out), _dot(directions[a], directions[b], n))
            case Distance():
                for out, pair in zip(group.out, group.pair, strict=True):
                    a, b = pairs[pair]
                    put(int(out), _distance(a.motion_from(b, a.body.axes), arguments.number("length", out)))
            case Affine():
                for k, out in enumerate(group.out):
                    row = cs.horzcat(*(arguments.number("affine", out, j) for j in range(n)))
                    value = multiply(row, cs.vertcat(*(configuration.q[j] for j in place)))
                    value, drift = value - arguments.number("affine_offset", out), cs.SX(1, 1)
                    if isinstance(group, Curved):
                        at = int(group.coordinate[k])
                        p, p_slope, p_curvature = _curve(group, k, configuration.q[place[at]])
                        value, drift, row = value - p, -p_curvature * v[at] ** 2, cs.SX(row)
                        row[at] = -p_slope
                    put(int(out), (value, row, drift))
            case RelativeLog():
                for k in range(len(group.joint_a)):
                    a, b = bodies[group.joint_a[k]], bodies[group.joint_b[k]]
                    log, jacobian = _relative_log(a, b, constant(group.rotation_a[k]), constant(group.rotation_b[k]), n)
                    rate = multiply(jacobian, v)
                    acceleration = configuration.directional_derivative(rate, q_dot)
                    for i in range(3):
                        put(int(group.out[3 * k + i]), (log[i], jacobian[i, :], acceleration[i]))
            case _:
                raise TypeError(f"{type(group).__name__}: compiled terms do not support this type of row")
    return RowTerms(phi, cs.sparsify(J), J_dot_v)


def _point(body: MovingBody, local: Any, n: int) -> _Point:
    position, rate, acceleration = body.point(local)
    return _Point(body, local, _MovingVector(position, rate, acceleration, body.point_jacobian(position, local, n)))


def _direction(body: MovingBody, local: Any, n: int) -> _MovingVector:
    import casadi as cs

    e, rate, acceleration = body.direction(local)
    jacobian, angular = cs.SX(3, n), body.angular_jacobian(n)
    for column in body.columns:
        if column.is_rotation:
            jacobian[:, column.index] = cross(angular[:, column.index], e)
    return _MovingVector(e, rate, acceleration, cs.sparsify(jacobian))


def _component(direction: tuple[MovingBody, Any], a: _Point, b: _Point, n: int) -> tuple[Any, Any, Any]:
    """Return the row e . (p_A - p_B), e fixed in a body.

    If that body carries one of the points, the other point's motion in the body's frame gives shorter expressions.
    """
    body, e = direction
    for fixed, other, sign in ((a, b, -1), (b, a, 1)):
        if body is fixed.body and body.columns:
            motion = other.motion_in_frame(body, n, sign)
            r = motion.value + fixed.local if sign < 0 else motion.value - fixed.local
            return dot(e, r), multiply(e.T, motion.jacobian), dot(e, motion.acceleration)
    return _product(_direction(body, e, n), a.motion_from(b, body.axes))


def _dot(first: tuple[MovingBody, Any], second: tuple[MovingBody, Any], n: int) -> tuple[Any, Any, Any]:
    """Return the row of two directions' scalar product, in the axes of the first one's branch."""
    (a, e_a), (b, e_b) = first, second
    return _product(_direction(a, e_a, n), _direction(b, e_b, n).rotated(b.axes.rotation_to(a.axes)))


def _product(a: _MovingVector, b: _MovingVector) -> tuple[Any, Any, Any]:
    """Return the row a . b."""
    return (
        dot(a.value, b.value),
        multiply(a.value.T, b.jacobian) + multiply(b.value.T, a.jacobian),
        dot(a.acceleration, b.value) + 2 * dot(a.rate, b.rate) + dot(a.value, b.acceleration),
    )


def _distance(r: _MovingVector, length: Any) -> tuple[Any, Any, Any]:
    """Return the row (|r|^2 - length^2) / (2 length)."""
    return (
        (dot(r.value, r.value) - length**2) / (2 * length),
        multiply(r.value.T / length, r.jacobian),
        (dot(r.rate, r.rate) + dot(r.value, r.acceleration)) / length,
    )


def _curve(group: Curved, k: int, x: Any) -> tuple[Any, Any, Any]:
    """Return the piecewise polynomial of row k of a group and its first two derivatives at x."""
    import casadi as cs

    pieces = int(np.isfinite(group.breaks[k]).sum()) + 1

    def select(numbers: Array) -> Any:
        value = cs.SX(numbers[0])
        for at, number in zip(group.breaks[k], numbers[1:], strict=False):
            value = cs.if_else(x >= at, number, value)
        return value

    s = x - select(group.origins[k, :pieces])
    powers = [select(column) for column in group.coefficients[k, :pieces].T]
    values = []
    for _ in range(3):
        values.append(_series(powers or [cs.SX(1, 1)], s))
        powers = [i * c for i, c in enumerate(powers)][1:]
    return values[0], values[1], values[2]


def _relative_log(a: MovingBody, b: MovingBody, rotation_a: Any, rotation_b: Any, n: int) -> tuple[Any, Any]:
    """Return log(R_A^T R_B) and its Jacobian."""
    import casadi as cs

    R = b.axes.rotation_to(a.axes)
    R_b = multiply(R, multiply(b.R, rotation_b))
    relative = multiply(multiply(a.R, rotation_a).T, R_b)
    sine = cs.vertcat(*(relative[j, i] - relative[i, j] for i, j in ((1, 2), (2, 0), (0, 1)))) / 2
    cosine = (cs.trace(relative) - 1) / 2
    square = dot(sine, sine)
    is_small = cs.logic_and(square < SERIES_SIN_SQUARED, cosine > 0)
    safe_square = cs.if_else(is_small, 1, square)  # both branches are evaluated; this keeps the other one finite
    length = cs.sqrt(safe_square)
    u = sine * cs.if_else(is_small, _series(_ARCSINE, square), cs.atan2(length, cosine) / length)
    theta_2 = dot(u, u)
    safe_theta_2 = cs.if_else(is_small, 1, theta_2)
    theta = cs.sqrt(safe_theta_2)
    closed_form = 1 / safe_theta_2 - cs.cos(theta / 2) / cs.sin(theta / 2) / (2 * theta)
    c = cs.if_else(is_small, _series(_LOG, theta_2), closed_form)
    s = cs.skew(u)
    rate = multiply(cs.SX.eye(3) + s / 2 + c * cs.mtimes(s, s), R_b.T)
    return u, multiply(rate, multiply(R, b.angular_jacobian(n)) - a.angular_jacobian(n))


def _series(coefficients: Sequence[float], x: Any) -> Any:
    value = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = coefficient + x * value
    return value


# arcsin(x) / x as a series in x^2; and c of Jlog(u) = 1 + [u] / 2 + c [u]^2 as a series in |u|^2.
_ARCSINE = [comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(9)]
_LOG = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160]
