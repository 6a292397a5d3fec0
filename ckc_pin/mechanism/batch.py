"""A closure at many configurations at once.

The row primitives take arrays of loops, whatever their number: many copies of a mechanism are one mechanism with
many loops. Only Pinocchio is called once a configuration, which costs two microseconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray, lazy
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.rows import Affine, Component, Distance, Dot, RelativeLog, Rows
from ckc_pin.mechanism.tree import Tree

__all__ = ["ManyPoses", "difference_many", "evaluate_closure", "integrate_many", "join_closures"]

Renumber = Callable[[IntArray], IntArray]

CHUNK = 2048  # configurations evaluated together: their arrays stay in the processor's cache


def evaluate_closure(tree: Tree, closure: Closure, q_tree: Array) -> tuple[Array, Array]:
    """Return phi and J of a closure at many configurations.

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
            phi[part, group.out], jacobian[part, group.out] = _evaluate(group, closure, pose)
    return phi, jacobian


def _evaluate(group: Rows, closure: Closure, pose: ManyPoses) -> tuple[Array, Array]:
    if isinstance(group, Affine):
        phi = pose.configurations[:, pose.tree.q_index] @ group.matrix.T - group.offset
        return phi, np.broadcast_to(group.matrix, (pose.count, *group.matrix.shape))
    copies = _copies(group, closure, pose)
    shape = (pose.count, len(group.out))
    return copies.phi(pose).reshape(shape), copies.jacobian(pose).reshape(*shape, pose.tree.n)


def _copies(group: Rows, closure: Closure, pose: ManyPoses) -> Rows:
    """Return a group of rows for each copy of the mechanism, as one group."""
    anchors, count = closure.anchors, pose.count

    def each(size: int) -> Renumber:
        return lambda numbers: (np.arange(count)[:, None] * size + numbers).ravel()

    several = renumbered(
        group, each(closure.rows), each(len(anchors.point_joint) // 2), each(len(anchors.direction_joint))
    )
    if isinstance(several, Distance):
        return replace(several, length=np.tile(several.length, count))
    if isinstance(several, RelativeLog):
        joint = each(pose.tree.model.njoints)
        return replace(
            several,
            joint_a=joint(several.joint_a),
            rotation_a=np.tile(several.rotation_a, (count, 1, 1)),
            joint_b=joint(several.joint_b),
            rotation_b=np.tile(several.rotation_b, (count, 1, 1)),
        )
    return several


def renumbered(group: Rows, rows: Renumber, pairs: Renumber, directions: Renumber) -> Rows:
    """Return a group of rows that refers to other numbers of rows, pairs and directions."""
    out = rows(group.out)
    if isinstance(group, Component):
        return replace(group, out=out, pair=pairs(group.pair), direction=directions(group.direction))
    if isinstance(group, Dot):
        return replace(group, out=out, a=directions(group.a), b=directions(group.b))
    if isinstance(group, Distance):
        return replace(group, out=out, pair=pairs(group.pair))
    if isinstance(group, Affine | RelativeLog):
        return replace(group, out=out)
    raise TypeError(f"rows of an unknown kind: {type(group).__name__}")


def join_closures(a: Closure, b: Closure) -> Closure:
    """Return one closure with the rows of two, those of the first one first."""
    pairs, directions = len(a.anchors.point_joint) // 2, len(a.anchors.direction_joint)
    more = tuple(
        renumbered(group, lambda k: k + a.rows, lambda k: k + pairs, lambda k: k + directions) for group in b.groups
    )
    ends = [(x.anchors, len(x.anchors.point_joint) // 2) for x in (a, b)]
    anchors = Anchors(
        np.concatenate([x.point_joint[:k] for x, k in ends] + [x.point_joint[k:] for x, k in ends]),
        np.concatenate([x.point_local[:k] for x, k in ends] + [x.point_local[k:] for x, k in ends]),
        np.concatenate([x.direction_joint for x, _ in ends]),
        np.concatenate([x.direction_local for x, _ in ends]),
    )
    aligned = tuple((loop, x + directions, y + directions) for loop, x, y in b.aligned)
    return Closure(anchors, a.groups + more, a.names + b.names, a.aligned + aligned, a.turned_by + b.turned_by)


def integrate_many(tree: Tree, q_tree: Array, step: Array) -> Array:
    """Move configurations (count, nq) by tangent steps (count, n)."""
    if tree.is_euclidean:
        return q_tree + step
    return np.array([pin.integrate(tree.model, q, dq) for q, dq in zip(q_tree, step, strict=True)]).reshape(
        q_tree.shape
    )


def difference_many(tree: Tree, start: Array, end: Array) -> Array:
    """Return the tangent steps (count, n) from configurations to others, (count, nq) each."""
    if tree.is_euclidean:
        return end - start
    return np.array([pin.difference(tree.model, a, b) for a, b in zip(start, end, strict=True)]).reshape(-1, tree.n)


class ManyPoses(Pose):
    """A tree at many configurations: what `Pose` has once it has for each, one after the other.

    Parameters
    ----------
    tree : Tree
    anchors : Anchors
    configurations : (count, nq) array
    """

    def __init__(self, tree: Tree, anchors: Anchors, configurations: Array) -> None:
        self.tree = tree
        self.anchors = anchors
        self.configurations = configurations
        self.count = len(configurations)
        placement, jacobian = tree.many_kinematics(configurations)
        self.rotation = placement[:, :, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        self.translation = placement[:, :, 9:].reshape(-1, 3)
        self.linear_part = jacobian[:, :3]
        self.angular_part = jacobian[:, 3:]

    def _joints(self, joint: IntArray) -> IntArray:
        return (np.arange(self.count)[:, None] * self.tree.model.njoints + joint).ravel()

    @lazy
    def p(self) -> Array:
        """World positions of the points, shape (count, 2 k, 3), metres."""
        at = self._joints(self.anchors.point_joint)
        local = np.tile(self.anchors.point_local, (self.count, 1))
        turned = (self.rotation[at] @ local[:, :, None])[:, :, 0]
        return (turned + self.translation[at]).reshape(self.count, len(self.anchors.point_joint), 3)

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
        return (self.p_jacobian[:, :k] - self.p_jacobian[:, k:]).reshape(-1, 3, self.tree.n)

    @lazy
    def e(self) -> Array:
        """World directions, shape (count * m, 3)."""
        at = self._joints(self.anchors.direction_joint)
        local = np.tile(self.anchors.direction_local, (self.count, 1))
        return (self.rotation[at] @ local[:, :, None])[:, :, 0]

    @lazy
    def e_angular(self) -> Array:
        """Angular Jacobians of what the directions are fixed in, shape (count * m, 3, n)."""
        return self.angular(self._joints(self.anchors.direction_joint))

    def angular(self, joint: IntArray) -> Array:
        """Angular Jacobians of joints, numbered through all copies, shape (len(joint), 3, n)."""
        copy, own = np.divmod(joint, self.tree.model.njoints)
        return self.tree.support[own] * self.angular_part[copy]
