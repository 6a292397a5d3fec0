"""Symbols of the configuration, and the kinematics of the tree's bodies as CasADi expressions.

Vectors of a branch are resolved in the axes in which its first joint is placed. More of their entries are zero there
than in the world's axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ckc_pin.codegen.arguments import Arguments, constant
from ckc_pin.codegen.branches import AxisRotations, BranchAxes
from ckc_pin.mechanism.tree import Tree

__all__ = ["Column", "ConfigurationSymbols", "MovingBody", "cross", "dot", "forward_kinematics", "multiply"]


class ConfigurationSymbols:
    """Symbols of q' (nq) and of the cosine and sine of each entry of q' (nq each).

    Cosines and sines are symbols of their own because the caller of the C code computes them once for all functions,
    several at a time. Derivatives with respect to q' treat them as functions of q'. Only those of angles are used.

    Parameters
    ----------
    nq : int

    Attributes
    ----------
    q, trig : casadi.SX of nq and 2 nq
        `trig` holds the cosines, then the sines.
    """

    def __init__(self, nq: int) -> None:
        import casadi as cs

        self.q, self.trig = cs.SX.sym("q", nq), cs.SX.sym("trig", 2 * nq)
        self._cosines, self._sines = self.trig[:nq], self.trig[nq:]

    def cosine_and_sine(self, index: int) -> tuple[Any, Any]:
        """Return the cosine and sine of an entry of q'."""
        return self._cosines[index], self._sines[index]

    def jacobian(self, x: Any) -> Any:
        """Return d x / d q'."""
        import casadi as cs

        direct, by_cosine, by_sine = (cs.jacobian(x, symbols) for symbols in (self.q, self._cosines, self._sines))
        return direct - cs.mtimes(by_cosine, cs.diag(self._sines)) + cs.mtimes(by_sine, cs.diag(self._cosines))

    def directional_derivative(self, x: Any, q_dot: Any) -> Any:
        """Return the derivative of x with respect to q', times q_dot."""
        import casadi as cs

        rates = cs.vertcat(q_dot, -self._sines * q_dot, self._cosines * q_dot)
        return cs.jtimes(x, cs.vertcat(self.q, self.trig), rates)

    def as_function_of_q(self, x: Any) -> Any:
        """Return x with the cosines and sines substituted by functions of q'."""
        import casadi as cs

        return cs.substitute(x, self.trig, cs.vertcat(cs.cos(self.q), cs.sin(self.q)))


@dataclass(frozen=True)
class Column:
    """A tangent coordinate's effect on the bodies behind its joint: rotation about an axis or translation along it.

    Attributes
    ----------
    index : int
        Of the coordinate in v'.
    is_rotation : bool
    axis, origin : casadi.SX of 3
        The axis and a point on it, in the branch's axes.
    local_axis : casadi.SX of 3
        The axis in its joint's frame.
    """

    index: int
    is_rotation: bool
    axis: Any
    origin: Any
    local_axis: Any


@dataclass(frozen=True)
class MovingBody:
    """A joint's frame in its branch's axes: rotation, origin, velocities and accelerations.

    Attributes
    ----------
    axes : BranchAxes
    R, origin : casadi.SX, (3, 3) and (3)
    omega, velocity, alpha, acceleration : casadi.SX of 3
        Angular velocity, velocity of the origin, and their rates.
    columns : tuple of Column
        Coordinates that move the body, from the root on.
    own_count : int
        How many of the last columns belong to the body's own joint.
    """

    axes: BranchAxes
    R: Any
    origin: Any
    omega: Any
    velocity: Any
    alpha: Any
    acceleration: Any
    columns: tuple[Column, ...]
    own_count: int

    def point(self, local: Any) -> tuple[Any, Any, Any]:
        """Return position, velocity and acceleration of a point fixed in the body."""
        lever = multiply(self.R, local)
        swept = cross(self.omega, lever)
        return (
            self.origin + lever,
            self.velocity + swept,
            self.acceleration + cross(self.alpha, lever) + cross(self.omega, swept),
        )

    def direction(self, local: Any) -> tuple[Any, Any, Any]:
        """Return a direction fixed in the body, its rate and its acceleration."""
        e = multiply(self.R, local)
        rate = cross(self.omega, e)
        return e, rate, cross(self.alpha, e) + cross(self.omega, rate)

    def point_jacobian(self, position: Any, local: Any, n: int) -> Any:
        """Return the Jacobian of a point fixed in the body with respect to v', (3, n)."""
        return self.carried_jacobian(position, n) + self.own_jacobian(self.R, local, n)

    def carried_jacobian(self, position: Any, n: int) -> Any:
        """Return the Jacobian's columns of the joints before the body's own, for any point that moves with the body."""
        import casadi as cs

        jacobian = cs.SX(3, n)
        for column in self.columns[: len(self.columns) - self.own_count]:
            moved = cross(column.axis, position - column.origin) if column.is_rotation else column.axis
            jacobian[:, column.index] = moved
        return cs.sparsify(jacobian)

    def own_jacobian(self, R: Any, local: Any, n: int) -> Any:
        """Return the Jacobian's columns of the body's own joint, for a point at `local`, rotated by R."""
        import casadi as cs

        jacobian = cs.SX(3, n)
        for column in self.columns[len(self.columns) - self.own_count :]:
            moved = cross(column.local_axis, local) if column.is_rotation else column.local_axis
            jacobian[:, column.index] = multiply(R, moved)
        return cs.sparsify(jacobian)

    def angular_jacobian(self, n: int) -> Any:
        """Return the Jacobian of the angular velocity with respect to v', (3, n)."""
        import casadi as cs

        jacobian = cs.SX(3, n)
        for column in self.columns:
            if column.is_rotation:
                jacobian[:, column.index] = column.axis
        return cs.sparsify(jacobian)


def cross(a: Any, b: Any) -> Any:
    """Return the cross product of two columns, with structural zeros removed."""
    import casadi as cs

    return cs.sparsify(cs.cross(a, b))


def dot(a: Any, b: Any) -> Any:
    """Return the scalar product of two columns, with structural zeros removed."""
    import casadi as cs

    return cs.sparsify(cs.dot(a, b))


def multiply(a: Any, b: Any) -> Any:
    """Return the product of two matrices, with structural zeros removed."""
    import casadi as cs

    return cs.sparsify(cs.mtimes(a, b))


def forward_kinematics(
    tree: Tree, rotations: AxisRotations, configuration: ConfigurationSymbols, v: Any, v_dot: Any, arguments: Arguments
) -> list[MovingBody]:
    """Return the body of each Pinocchio joint, the world first.

    Parameters
    ----------
    tree : Tree
    rotations : AxisRotations
        Between the axes of the branches.
    configuration : ConfigurationSymbols
        Pinocchio's q', a free root's quaternion of unit length.
    v, v_dot : casadi.SX of n
        v' and its rate.
    arguments : Arguments
        Symbols of the joints' offsets.
    """
    import casadi as cs

    model, zero, q = tree.model, cs.SX(3, 1), configuration.q
    world = MovingBody(BranchAxes(rotations, 0), cs.SX.eye(3), zero, zero, zero, zero, zero, (), 0)
    bodies = [world]
    for k in range(1, model.njoints):
        joint, placement, parent = model.joints[k], model.jointPlacements[k], bodies[model.parents[k]]
        placed = multiply(parent.R, constant(placement.rotation))
        if parent is world:
            parent = replace(world, axes=BranchAxes(rotations, k), R=rotations.rotation(0, k))
            placed = cs.SX.eye(3)
        offset = multiply(parent.R, arguments.column("offset", k))
        in_q, in_v = joint.idx_q, joint.idx_v
        if joint.nq == 7:
            q_root, v_root, v_dot_root = q[in_q : in_q + 7], v[in_v : in_v + 6], v_dot[in_v : in_v + 6]
            bodies.append(_free_body(parent, placed, offset, q_root, v_root, v_dot_root, in_v))
            continue
        local, is_rotation = tree.axis(k)
        axis = multiply(placed, constant(local))
        R = multiply(placed, _rotation_about(local, *configuration.cosine_and_sine(in_q))) if is_rotation else placed
        offset = offset if is_rotation else offset + axis * q[in_q]
        column = Column(in_v, is_rotation, axis, parent.origin + offset, constant(local))
        bodies.append(_body_on_axis(parent, R, offset, axis * v[in_v], axis * v_dot[in_v], column))
    return bodies


def _body_on_axis(parent: MovingBody, R: Any, offset: Any, rate: Any, rate_dot: Any, column: Column) -> MovingBody:
    """Return the body of a revolute or prismatic joint."""
    omega, alpha = parent.omega, parent.alpha
    swept = cross(omega, offset)
    velocity = parent.velocity + swept
    acceleration = parent.acceleration + cross(alpha, offset) + cross(omega, swept)
    if column.is_rotation:
        alpha = alpha + cross(omega, rate) + rate_dot
        omega = omega + rate
    else:
        velocity = velocity + rate
        acceleration = acceleration + 2 * cross(omega, rate) + rate_dot
    columns = (*parent.columns, column)
    return MovingBody(parent.axes, R, column.origin, omega, velocity, alpha, acceleration, columns, 1)


def _free_body(parent: MovingBody, placed: Any, offset: Any, q: Any, v: Any, v_dot: Any, index: int) -> MovingBody:
    """Return the body of a free root, whose v' is a twist in its own axes."""
    import casadi as cs

    offset = offset + multiply(placed, q[:3])
    R = multiply(placed, _quaternion_rotation(q[3:]))
    translation, spin = multiply(R, v[:3]), multiply(R, v[3:])
    omega, swept = parent.omega + spin, cross(parent.omega, offset)
    origin = parent.origin + offset
    unit = cs.SX.eye(3)
    columns = [Column(index + k, k >= 3, R[:, k % 3], origin, cs.sparsify(unit[:, k % 3])) for k in range(6)]
    return MovingBody(
        parent.axes,
        R,
        origin,
        omega,
        parent.velocity + swept + translation,
        parent.alpha + cross(parent.omega, spin) + multiply(R, v_dot[3:]),
        cs.sparsify(
            parent.acceleration
            + cross(parent.alpha, offset)
            + cross(parent.omega, swept + translation)
            + cross(omega, translation)
            + multiply(R, v_dot[:3])
        ),
        (*parent.columns, *columns),
        6,
    )


def _rotation_about(axis: Any, cosine: Any, sine: Any) -> Any:
    """Return the rotation about a unit axis by an angle of this cosine and sine (Rodrigues' formula)."""
    import casadi as cs

    a = constant(axis)
    parallel = constant(np.outer(axis, axis))
    return cs.sparsify(parallel + cosine * constant(np.eye(3) - np.outer(axis, axis)) + sine * cs.skew(a))


def _quaternion_rotation(x: Any) -> Any:
    """Return the rotation of a unit quaternion (x, y, z, w)."""
    import casadi as cs

    u, w = x[:3], x[3]
    return cs.SX.eye(3) + 2 * w * cs.skew(u) + 2 * cs.mtimes(cs.skew(u), cs.skew(u))
