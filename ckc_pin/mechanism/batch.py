"""Evaluate constraint rows and their Jacobians at many configurations at once.

The row primitives operate on arrays of loops, so many copies of a mechanism are evaluated as one mechanism with many
loops. Only Pinocchio is called for each configuration, which takes two microseconds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, IntArray, lazy
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Anchors, Pose, dot_rows
from ckc_pin.mechanism.rows import Affine, Component, Curved, Distance, Dot, RelativeLog, Rows
from ckc_pin.mechanism.tree import Tree

__all__ = ["ManyPoses", "difference_many", "evaluate_closure", "evaluate_group", "integrate_many", "join_closures"]

Renumber = Callable[[IntArray], IntArray]

CHUNK = 2048  # configurations evaluated together, so that their arrays fit in the cache


def evaluate_closure(tree: Tree, closure: Closure, q_tree: Array) -> tuple[Array, Array]:
    """Return the residual phi and the constraint Jacobian J at many configurations.

    Parameters
    ----------
    tree : Tree
    closure : Closure
    q_tree : (count, nq) array

    Returns
    -------
    phi : (count, rows) array
    J : (count, rows, n) array
    """
    phi = np.empty((len(q_tree), closure.rows))
    jacobian = np.empty((len(q_tree), closure.rows, tree.n))
    for start in range(0, len(q_tree), CHUNK):
        part = slice(start, start + CHUNK)
        pose = ManyPoses(tree, closure.anchors, q_tree[part])
        for group in closure.groups:
            phi[part, group.out], jacobian[part, group.out] = evaluate_group(group, closure, pose)
    return phi, jacobian


def evaluate_group(group: Rows, closure: Closure, pose: ManyPoses) -> tuple[Array, Array]:
    """Return the residual (count, rows) of one group of rows, and its Jacobian (count, rows, columns)."""
    if isinstance(group, Affine):
        phi = pose.configurations[:, pose.tree.q_index] @ group.matrix.T - group.offset
        jacobian = np.broadcast_to(group.matrix, (pose.count, *group.matrix.shape))
        if isinstance(group, Curved):
            x, jacobian = pose.configurations[:, pose.tree.q_index[group.coordinate]], jacobian.copy()
            phi = phi - group.curve(x, 0)
            jacobian[:, np.arange(len(group.out)), group.coordinate] -= group.curve(x, 1)
        return phi, jacobian
    copies = _repeat(group, closure, pose)
    shape = (pose.count, len(group.out))
    return copies.phi(pose).reshape(shape), copies.jacobian(pose).reshape(*shape, pose.columns)


def _repeat(group: Rows, closure: Closure, pose: ManyPoses) -> Rows:
    """Return one group with the rows of all copies of the mechanism."""
    anchors, count = closure.anchors, pose.count

    def offset_by(size: int) -> Renumber:
        return lambda numbers: (np.arange(count)[:, None] * size + numbers).ravel()

    repeated = renumber(
        group,
        offset_by(closure.rows),
        offset_by(len(anchors.point_joint) // 2),
        offset_by(len(anchors.direction_joint)),
    )
    if isinstance(repeated, Distance):
        return replace(repeated, length=np.tile(repeated.length, count))
    if isinstance(repeated, RelativeLog):
        renumber_joint = offset_by(pose.bodies)
        return replace(
            repeated,
            joint_a=renumber_joint(repeated.joint_a),
            rotation_a=np.tile(repeated.rotation_a, (count, 1, 1)),
            joint_b=renumber_joint(repeated.joint_b),
            rotation_b=np.tile(repeated.rotation_b, (count, 1, 1)),
        )
    return repeated


def renumber(group: Rows, rows: Renumber, pairs: Renumber, directions: Renumber) -> Rows:
    """Return a group with new numbers of its rows, pairs and directions."""
    out = rows(group.out)
    if isinstance(group, Component):
        return replace(group, out=out, pair=pairs(group.pair), direction=directions(group.direction))
    if isinstance(group, Dot):
        return replace(group, out=out, a=directions(group.a), b=directions(group.b))
    if isinstance(group, Distance):
        return replace(group, out=out, pair=pairs(group.pair))
    if isinstance(group, Affine | RelativeLog):
        return replace(group, out=out)
    raise TypeError(f"renumber: unknown row primitive {type(group).__name__}")


def join_closures(a: Closure, b: Closure) -> Closure:
    """Return a closure with the rows of `a`, then those of `b`."""
    pairs, directions = len(a.anchors.point_joint) // 2, len(a.anchors.direction_joint)
    more = tuple(
        renumber(group, lambda k: k + a.rows, lambda k: k + pairs, lambda k: k + directions) for group in b.groups
    )
    ends = [(x.anchors, len(x.anchors.point_joint) // 2) for x in (a, b)]
    anchors = Anchors(
        np.concatenate([x.point_joint[:k] for x, k in ends] + [x.point_joint[k:] for x, k in ends]),
        np.concatenate([x.point_local[:k] for x, k in ends] + [x.point_local[k:] for x, k in ends]),
        np.concatenate([x.direction_joint for x, _ in ends]),
        np.concatenate([x.direction_local for x, _ in ends]),
    )
    aligned = tuple((loop, x + directions, y + directions) for loop, x, y in b.aligned)
    return Closure(
        anchors, a.groups + more, a.names + b.names, a.aligned + aligned, a.direction_frames + b.direction_frames
    )


def integrate_many(tree: Tree, q_tree: Array, step: Array) -> Array:
    """Return the configurations (count, nq) that tangent steps (count, n) lead to."""
    if tree.is_euclidean:
        return q_tree + step
    return np.array([pin.integrate(tree.model, q, dq) for q, dq in zip(q_tree, step, strict=True)]).reshape(
        q_tree.shape
    )


def difference_many(tree: Tree, start: Array, end: Array) -> Array:
    """Return the tangent steps (count, n) from configurations `start` to `end`, (count, nq) each."""
    if tree.is_euclidean:
        return end - start
    return np.array([pin.difference(tree.model, a, b) for a, b in zip(start, end, strict=True)]).reshape(-1, tree.n)


class ManyPoses(Pose):
    """The quantities of `Pose` at many configurations, one after the other.

    Parameters
    ----------
    tree : Tree
    anchors : Anchors
    configurations : (count, nq) array

    Attributes
    ----------
    bodies, columns : int
        Number of bodies that anchors may refer to, the joints, and of columns of the Jacobians.
    """

    def __init__(self, tree: Tree, anchors: Anchors, configurations: Array) -> None:
        self.tree = tree
        self.bodies, self.columns = tree.model.njoints, tree.n
        self.anchors = anchors
        self.configurations = configurations
        self.count = len(configurations)
        placement, jacobian = tree.many_kinematics(configurations)
        self.rotation = placement[:, :, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        self.translation = placement[:, :, 9:].reshape(-1, 3)
        self.linear_part = jacobian[:, :3]
        self.angular_part = jacobian[:, 3:]

    def _joints(self, joint: IntArray) -> IntArray:
        return (np.arange(self.count)[:, None] * self.bodies + joint).ravel()

    @lazy
    def p(self) -> Array:
        """Positions of the points in the world, shape (count, 2 k, 3), metres."""
        at = self._joints(self.anchors.point_joint)
        local = np.tile(self.anchors.point_local, (self.count, 1))
        rotated = (self.rotation[at] @ local[:, :, None])[:, :, 0]
        return (rotated + self.translation[at]).reshape(self.count, len(self.anchors.point_joint), 3)

    @lazy
    def r(self) -> Array:
        """Differences p_A - p_B, shape (count * k, 3)."""
        k = self.p.shape[1] // 2
        return (self.p[:, :k] - self.p[:, k:]).reshape(-1, 3)

    @lazy
    def p_jacobian(self) -> Array:
        """Jacobians of the points, shape (count, 2 k, 3, n)."""
        x, y, z = (self.p[:, :, k, None] for k in range(3))
        a, b, c = (self.angular_part[:, None, k] for k in range(3))
        moved = np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=2) + self.linear_part[:, None]
        return moved * self.tree.support[self.anchors.point_joint]

    @lazy
    def r_jacobian(self) -> Array:
        """Jacobians of the differences, shape (count * k, 3, n)."""
        k = self.p.shape[1] // 2
        return (self.p_jacobian[:, :k] - self.p_jacobian[:, k:]).reshape(-1, 3, self.columns)

    def project_r_jacobian(self, pair: IntArray, e: Array) -> Array:
        """Return the rows e_i . d r_i / dq' of vectors e (k, 3), shape (k, n)."""
        return dot_rows(e, self.r_jacobian[pair])

    def project_e_angular(self, direction: IntArray, torque: Array) -> Array:
        """Return the rows torque_i . d omega_i / dv' of the joints that directions are fixed to, shape (k, n)."""
        return dot_rows(torque, self.e_angular[direction])

    @lazy
    def e(self) -> Array:
        """Directions in world axes, shape (count * m, 3)."""
        at = self._joints(self.anchors.direction_joint)
        local = np.tile(self.anchors.direction_local, (self.count, 1))
        return (self.rotation[at] @ local[:, :, None])[:, :, 0]

    @lazy
    def e_angular(self) -> Array:
        """Angular Jacobians of the joints that the directions are fixed to, shape (count * m, 3, n)."""
        return self.angular(self._joints(self.anchors.direction_joint))

    def angular(self, joint: IntArray) -> Array:
        """Angular Jacobians of joints, which are numbered across all copies, shape (len(joint), 3, n)."""
        copy, number = np.divmod(joint, self.bodies)
        return self.tree.support[number] * self.angular_part[copy]
