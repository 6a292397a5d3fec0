"""Numbers for q: joint coordinates as they are; a free root's place by its position and a rotation vector.

The rotation vector is relative to a reference orientation, so that it stays small when the reference
follows the motion: no chart of rotations is good everywhere.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.mechanism.tree import Tree

__all__ = ["Chart"]


class Chart:
    """A chart of the independent coordinates around a configuration.

    Parameters
    ----------
    tree : Tree
    independent : (d,) int array
        Tangent coordinates; those of a free root all or none.
    q_tree : (nq,) array
        Its orientations of free roots are the references.

    Attributes
    ----------
    plain : bool
        No free root among them: the numbers are joint coordinates and their rates are q_dot.
    """

    def __init__(self, tree: Tree, independent: IntArray, q_tree: Array) -> None:
        self._tree = tree
        self._independent = independent
        self._place = tree.q_index[independent]
        inside = set(independent.tolist())
        self._roots = [
            (q_at, [int(np.flatnonzero(independent == v_at + k)[0]) for k in range(6)], _rotation(q_tree, q_at))
            for q_at, v_at in tree.free_roots
            if v_at in inside
        ]
        self.plain = not self._roots

    def numbers(self, q_tree: Array) -> Array:
        """Chart of a configuration, shape (d,)."""
        numbers = np.array(q_tree[self._place])
        for q_at, at, reference in self._roots:
            numbers[at[:3]] = q_tree[q_at : q_at + 3]
            numbers[at[3:]] = pin.log3(reference.T @ _rotation(q_tree, q_at))
        return numbers

    def step(self, q_tree: Array, numbers: Array) -> Array:
        """Tangent step of the independent coordinates from a configuration to chart numbers, shape (d,)."""
        step = numbers - q_tree[self._place]
        for q_at, at, reference in self._roots:
            start = pin.SE3(_rotation(q_tree, q_at), q_tree[q_at : q_at + 3])
            end = pin.SE3(reference @ pin.exp3(numbers[at[3:]]), numbers[at[:3]])
            step[at] = pin.log6(start.actInv(end)).vector
        return step

    def steps(self, q_trees: Array, numbers: Array) -> Array:
        """`step` from several configurations, shape (k, d); rotations as differences of numbers, to compare sizes."""
        if self.plain:
            return np.asarray(numbers - q_trees[:, self._place])
        return np.array([numbers - self.numbers(q_tree) for q_tree in q_trees])

    def rate(self, q_tree: Array, q_dot: Array) -> Array:
        """Rate of the chart numbers at tangent velocity q_dot, shape (d,)."""
        if self.plain:
            return q_dot
        rate = np.array(q_dot)
        for q_at, at, reference in self._roots:
            rotation = _rotation(q_tree, q_at)
            rate[at[:3]] = rotation @ q_dot[at[:3]]
            rate[at[3:]] = pin.Jlog3(reference.T @ rotation) @ q_dot[at[3:]]
        return rate


def _rotation(q_tree: Array, q_at: int) -> Array:
    quaternion = pin.Quaternion(np.ascontiguousarray(q_tree[q_at + 3 : q_at + 7]))
    return np.array(quaternion.normalized().matrix())
