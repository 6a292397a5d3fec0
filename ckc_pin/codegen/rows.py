"""The closure's rows as expressions, by the primitives of `mechanism.rows`: phi, J and J_dot v."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

from ckc_pin.codegen.angles import Angles
from ckc_pin.codegen.arguments import Arguments, constant
from ckc_pin.codegen.axes import Axes
from ckc_pin.codegen.bodies import MovingBody, cross, dot, times
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.rows import Affine, Component, Distance, Dot, RelativeLog

__all__ = ["RowTerms", "row_terms"]

NEAR_PARALLEL = 0.0025  # of sin^2 of the angle, rad^2: series below


@dataclass(frozen=True)
class RowTerms:
    """phi (rows), J (rows, n) and J_dot v (rows)."""

    phi: Any
    J: Any
    J_dot_v: Any


@dataclass(frozen=True)
class _Moving:
    """A vector, its rate, its acceleration at dv'/dt = 0, and its derivative along v', (3, n)."""

    value: Any
    rate: Any
    acceleration: Any
    jacobian: Any

    def __sub__(self, other: _Moving) -> _Moving:
        return _Moving(
            self.value - other.value,
            self.rate - other.rate,
            self.acceleration - other.acceleration,
            self.jacobian - other.jacobian,
        )

    def turned(self, R: Any) -> _Moving:
        """The same in axes that stand still, too."""
        return _Moving(*(times(R, x) for x in (self.value, self.rate, self.acceleration, self.jacobian)))


@dataclass(frozen=True)
class _Point:
    """A point of a body, `local` in its frame, and how it moves in the axes of the body's branch."""

    body: MovingBody
    local: Any
    moving: _Moving

    def seen(self, axes: Axes) -> _Moving:
        """How it moves in other axes that stand still."""
        return self.moving.turned(self.body.axes.into(axes))

    def less(self, other: _Point, axes: Axes) -> _Moving:
        """How it moves against another, in axes that stand still."""
        return self.seen(axes) - other.seen(axes)

    def within(self, body: MovingBody, n: int, sign: int) -> _Moving:
        """How it moves in a body's own frame, or the same with the other sign."""
        import casadi as cs

        here = self.seen(body.axes)

        def less(x: Any, y: Any) -> Any:
            return x - y if sign > 0 else y - x

        lever = less(here.value, body.origin)
        swept = cross(body.omega, lever)
        rate = less(here.rate, body.speed) - swept
        acceleration = less(here.acceleration, body.acceleration) - cross(body.alpha, lever)
        acceleration = acceleration - cross(body.omega, swept + 2 * rate)
        value, rate, acceleration = (times(body.R.T, x) for x in (lever, rate, acceleration))
        into = self.body.axes.into(body.axes)
        carried = times(into, self.body.carried_jacobian(self.moving.value, n))
        carried = times(body.R.T, less(carried, body.carried_jacobian(here.value, n)))
        own = self.body.own_jacobian(times(body.R.T, times(into, self.body.R)), self.local, n)
        jacobian = carried + sign * own - sign * body.own_jacobian(cs.SX.eye(3), sign * value, n)
        return _Moving(value, rate, acceleration, jacobian)


def row_terms(
    closure: Closure,
    bodies: Sequence[MovingBody],
    angles: Angles,
    v: Any,
    q_dot: Any,
    place: Sequence[int],
    arguments: Arguments,
) -> RowTerms:
    """Return a closure's rows.

    Parameters
    ----------
    closure : Closure
    bodies : sequence of MovingBody
    angles : Angles
        Pinocchio's q'.
    v, q_dot : casadi.SX
        v', and the rate of q' at it.
    place : sequence of int
        Where the coordinates of joints of one freedom stand in q'.
    arguments : Arguments
        Takes the offsets of frames, lengths of rods, ratios and offsets of couplings.
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
                    one, other = pairs[pair]
                    put(int(out), _component(directions[direction], one, other, n))
            case Dot():
                for out, a, b in zip(group.out, group.a, group.b, strict=True):
                    put(int(out), _dot(directions[a], directions[b], n))
            case Distance():
                for out, pair in zip(group.out, group.pair, strict=True):
                    one, other = pairs[pair]
                    put(int(out), _distance(one.less(other, one.body.axes), arguments.number("length", out)))
            case Affine():
                for out in group.out:
                    row = cs.horzcat(*(arguments.number("affine", out, k) for k in range(n)))
                    value = times(row, cs.vertcat(*(angles.q[k] for k in place)))
                    put(int(out), (value - arguments.number("affine_offset", out), row, 0))
            case RelativeLog():
                for k in range(len(group.joint_a)):
                    a, b = bodies[group.joint_a[k]], bodies[group.joint_b[k]]
                    found = _parallel(a, b, constant(group.rotation_a[k]), constant(group.rotation_b[k]), n)
                    rate = times(found[1], v)
                    along = angles.along(rate, q_dot)
                    for i in range(3):
                        put(int(group.out[3 * k + i]), (found[0][i], found[1][i, :], along[i]))
            case _:
                raise TypeError(f"{type(group).__name__}: no such primitive is written out")
    return RowTerms(phi, cs.sparsify(J), J_dot_v)


def _point(body: MovingBody, local: Any, n: int) -> _Point:
    at, rate, acceleration = body.point(local)
    return _Point(body, local, _Moving(at, rate, acceleration, body.point_jacobian(at, local, n)))


def _direction(body: MovingBody, local: Any, n: int) -> _Moving:
    import casadi as cs

    e, rate, acceleration = body.direction(local)
    jacobian, turns = cs.SX(3, n), body.turn_jacobian(n)
    for column in body.columns:
        if column.turns:
            jacobian[:, column.at] = cross(turns[:, column.at], e)
    return _Moving(e, rate, acceleration, cs.sparsify(jacobian))


def _component(direction: tuple[MovingBody, Any], a: _Point, b: _Point, n: int) -> tuple[Any, Any, Any]:
    """e . (p_A - p_B), e fixed in a body: where that carries one of the points, by how the other moves within it."""
    body, e = direction
    for fixed, other, sign in ((a, b, -1), (b, a, 1)):
        if body is fixed.body and body.columns:
            seen = other.within(body, n, sign)
            at = seen.value + fixed.local if sign < 0 else seen.value - fixed.local
            return dot(e, at), times(e.T, seen.jacobian), dot(e, seen.acceleration)
    return _product(_direction(body, e, n), a.less(b, body.axes))


def _dot(one: tuple[MovingBody, Any], other: tuple[MovingBody, Any], n: int) -> tuple[Any, Any, Any]:
    """The row of two directions, in the axes of the first one's branch."""
    (a, e_a), (b, e_b) = one, other
    return _product(_direction(a, e_a, n), _direction(b, e_b, n).turned(b.axes.into(a.axes)))


def _product(a: _Moving, b: _Moving) -> tuple[Any, Any, Any]:
    """The row a . b."""
    return (
        dot(a.value, b.value),
        times(a.value.T, b.jacobian) + times(b.value.T, a.jacobian),
        dot(a.acceleration, b.value) + 2 * dot(a.rate, b.rate) + dot(a.value, b.acceleration),
    )


def _distance(r: _Moving, length: Any) -> tuple[Any, Any, Any]:
    return (
        (dot(r.value, r.value) - length**2) / (2 * length),
        times(r.value.T / length, r.jacobian),
        (dot(r.rate, r.rate) + dot(r.value, r.acceleration)) / length,
    )


def _parallel(a: MovingBody, b: MovingBody, rotation_a: Any, rotation_b: Any, n: int) -> tuple[Any, Any]:
    """log(R_A^T R_B) and its Jacobian."""
    import casadi as cs

    into = b.axes.into(a.axes)
    R_b = times(into, times(b.R, rotation_b))
    relative = times(times(a.R, rotation_a).T, R_b)
    sine = cs.vertcat(*(relative[j, i] - relative[i, j] for i, j in ((1, 2), (2, 0), (0, 1)))) / 2
    cosine = (cs.trace(relative) - 1) / 2
    square = dot(sine, sine)
    near = cs.logic_and(square < NEAR_PARALLEL, cosine > 0)
    apart = cs.if_else(near, 1, square)  # what the branch that is not taken is evaluated at
    length = cs.sqrt(apart)
    u = sine * cs.if_else(near, _series(_ARCSINE, square), cs.atan2(length, cosine) / length)
    theta_2 = dot(u, u)
    away = cs.if_else(near, 1, theta_2)
    theta = cs.sqrt(away)
    c = cs.if_else(near, _series(_LOG, theta_2), 1 / away - cs.cos(theta / 2) / cs.sin(theta / 2) / (2 * theta))
    s = cs.skew(u)
    rate = times(cs.SX.eye(3) + s / 2 + c * cs.mtimes(s, s), R_b.T)
    return u, times(rate, times(into, b.turn_jacobian(n)) - a.turn_jacobian(n))


def _series(coefficients: Sequence[float], x: Any) -> Any:
    value = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = coefficient + x * value
    return value


# arcsin(x) / x in x^2; and c of Jlog(u) = 1 + [u] / 2 + c [u]^2 in |u|^2
_ARCSINE = [comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(9)]
_LOG = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160]
