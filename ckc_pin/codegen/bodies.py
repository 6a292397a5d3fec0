"""The tree as expressions: where its bodies are, and how they move.

Vectors of a branch are resolved in the axes that its first joint is placed with, in which more of them is zero than in
the world's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ckc_pin.codegen.angles import Angles
from ckc_pin.codegen.arguments import Arguments, constant
from ckc_pin.codegen.axes import Axes, Turns
from ckc_pin.mechanism.tree import Tree

__all__ = ["Column", "MovingBody", "bodies"]


@dataclass(frozen=True)
class Column:
    """What one tangent coordinate does to every body above it: it turns about an axis, or slides along one.

    `local` is that axis in its joint's frame.
    """

    at: int
    turns: bool
    axis: Any
    origin: Any
    local: Any


@dataclass(frozen=True)
class MovingBody:
    """A joint's frame in its branch's axes: rotation, origin, its rates and its accelerations.

    `own` is the number of the last columns that are its joint's own.
    """

    axes: Axes
    R: Any
    origin: Any
    omega: Any
    speed: Any
    alpha: Any
    acceleration: Any
    columns: tuple[Column, ...]
    own: int

    def point(self, local: Any) -> tuple[Any, Any, Any]:
        """Position, velocity and acceleration of a point fixed in the body."""
        lever = times(self.R, local)
        turned = cross(self.omega, lever)
        return (
            self.origin + lever,
            self.speed + turned,
            self.acceleration + cross(self.alpha, lever) + cross(self.omega, turned),
        )

    def direction(self, local: Any) -> tuple[Any, Any, Any]:
        """A direction fixed in the body, its rate and its acceleration."""
        e = times(self.R, local)
        turned = cross(self.omega, e)
        return e, turned, cross(self.alpha, e) + cross(self.omega, turned)

    @property
    def own_columns(self) -> tuple[Column, ...]:
        """Its own joint's."""
        return self.columns[len(self.columns) - self.own :]

    def point_jacobian(self, at: Any, local: Any, n: int) -> Any:
        """d position / d q', (3, n), of a point fixed in the body."""
        return self.carried_jacobian(at, n) + self.own_jacobian(self.R, local, n)

    def carried_jacobian(self, at: Any, n: int) -> Any:
        """The columns of the joints before its own, of any point that moves with the body."""
        import casadi as cs

        found = cs.SX(3, n)
        for column in self.columns[: len(self.columns) - self.own]:
            found[:, column.at] = cross(column.axis, at - column.origin) if column.turns else column.axis
        return cs.sparsify(found)

    def own_jacobian(self, R: Any, local: Any, n: int) -> Any:
        """The columns of its own joint, of a point at `local`, turned by R from the joint's frame."""
        import casadi as cs

        found = cs.SX(3, n)
        for column in self.columns[len(self.columns) - self.own :]:
            found[:, column.at] = times(R, cross(column.local, local) if column.turns else column.local)
        return cs.sparsify(found)

    def turn_jacobian(self, n: int) -> Any:
        """Angular velocity by v', (3, n)."""
        import casadi as cs

        found = cs.SX(3, n)
        for column in self.columns:
            if column.turns:
                found[:, column.at] = column.axis
        return cs.sparsify(found)


def cross(a: Any, b: Any) -> Any:
    """a x b, of columns."""
    import casadi as cs

    return cs.sparsify(cs.cross(a, b))


def dot(a: Any, b: Any) -> Any:
    """a . b, of columns."""
    import casadi as cs

    return cs.sparsify(cs.dot(a, b))


def times(a: Any, b: Any) -> Any:
    """The product of two matrices, without what is zero in it."""
    import casadi as cs

    return cs.sparsify(cs.mtimes(a, b))


def bodies(tree: Tree, turns: Turns, angles: Angles, v: Any, v_dot: Any, arguments: Arguments) -> list[MovingBody]:
    """Return the body of each of Pinocchio's joints, the world first.

    Parameters
    ----------
    tree : Tree
    turns : Turns
        Of the axes of its joints.
    angles : Angles
        Pinocchio's q', a free root's quaternion of unit length.
    v, v_dot : casadi.SX of n
        v', and its rate.
    arguments : Arguments
        Takes the offsets of the joints.
    """
    import casadi as cs

    model, none, q = tree.model, cs.SX(3, 1), angles.q
    world = MovingBody(Axes(turns, 0), cs.SX.eye(3), none, none, none, none, none, (), 0)
    found = [world]
    for k in range(1, model.njoints):
        joint, placement, parent = model.joints[k], model.jointPlacements[k], found[model.parents[k]]
        stands = times(parent.R, constant(placement.rotation))
        if parent is world:
            parent = replace(world, axes=Axes(turns, k), R=turns.between(0, k))
            stands = cs.SX.eye(3)
        d = times(parent.R, arguments.column("offset", k))
        at_q, at_v = joint.idx_q, joint.idx_v
        if joint.nq == 7:
            found.append(_free(parent, stands, d, q[at_q : at_q + 7], v[at_v : at_v + 6], v_dot[at_v : at_v + 6], at_v))
            continue
        local, turning = tree.axis(k)
        axis = times(stands, constant(local))
        R = times(stands, _turn(local, *angles.turn(at_q))) if turning else stands
        d = d if turning else d + axis * q[at_q]
        column = Column(at_v, turning, axis, parent.origin + d, constant(local))
        found.append(_moved(parent, R, d, axis * v[at_v], axis * v_dot[at_v], column))
    return found


def _moved(parent: MovingBody, R: Any, d: Any, rate: Any, more: Any, column: Column) -> MovingBody:
    omega, alpha = parent.omega, parent.alpha
    swept = cross(omega, d)
    speed = parent.speed + swept
    acceleration = parent.acceleration + cross(alpha, d) + cross(omega, swept)
    if column.turns:
        alpha = alpha + cross(omega, rate) + more
        omega = omega + rate
    else:
        speed = speed + rate
        acceleration = acceleration + 2 * cross(omega, rate) + more
    columns = (*parent.columns, column)
    return MovingBody(parent.axes, R, column.origin, omega, speed, alpha, acceleration, columns, 1)


def _free(parent: MovingBody, stands: Any, d: Any, q: Any, v: Any, v_dot: Any, at: int) -> MovingBody:
    import casadi as cs

    d = d + times(stands, q[:3])
    R = times(stands, _of_quaternion(q[3:]))
    slide, spin = times(R, v[:3]), times(R, v[3:])
    omega, swept = parent.omega + spin, cross(parent.omega, d)
    origin = parent.origin + d
    unit = cs.SX.eye(3)
    columns = [Column(at + k, k >= 3, R[:, k % 3], origin, cs.sparsify(unit[:, k % 3])) for k in range(6)]
    return MovingBody(
        parent.axes,
        R,
        origin,
        omega,
        parent.speed + swept + slide,
        parent.alpha + cross(parent.omega, spin) + times(R, v_dot[3:]),
        cs.sparsify(
            parent.acceleration
            + cross(parent.alpha, d)
            + cross(parent.omega, swept + slide)
            + cross(omega, slide)
            + times(R, v_dot[:3])
        ),
        (*parent.columns, *columns),
        6,
    )


def _turn(axis: Any, c: Any, s: Any) -> Any:
    """Rotation about an axis of unit length by an angle of that cosine and sine: Rodrigues' formula."""
    import casadi as cs

    a = constant(axis)
    along = constant(np.outer(axis, axis))
    return cs.sparsify(along + c * constant(np.eye(3) - np.outer(axis, axis)) + s * cs.skew(a))


def _of_quaternion(x: Any) -> Any:
    """Rotation of a quaternion (x, y, z, w) of unit length."""
    import casadi as cs

    u, w = x[:3], x[3]
    return cs.SX.eye(3) + 2 * w * cs.skew(u) + 2 * cs.mtimes(cs.skew(u), cs.skew(u))
