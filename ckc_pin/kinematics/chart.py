"""Charts of the independent coordinates: joint coordinates, and position and rotation vector of a free root.

No chart of rotations is regular everywhere. The rotation vector is therefore relative to a reference orientation that
follows the motion, so that it stays small.
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
        Places of the independent coordinates; of a free root all six or none.
    q_tree : (nq,) array
        The configuration whose orientations of free roots are the references.

    Attributes
    ----------
    is_trivial : bool
        There is no free root, so that the numbers are joint coordinates and their rates are q_dot.
    """

    def __init__(self, tree: Tree, independent: IntArray, q_tree: Array) -> None:
        self._tree = tree
        self._independent = independent
        self._place = tree.q_index[independent]
        members = set(independent.tolist())
        self._roots = [
            (q_at, [int(np.flatnonzero(independent == v_at + k)[0]) for k in range(6)], _rotation(q_tree, q_at))
            for q_at, v_at in tree.free_roots
            if v_at in members
        ]
        self.is_trivial = not self._roots

    def numbers(self, q_tree: Array) -> Array:
        """Return the chart numbers of a configuration, shape (d,)."""
        numbers = np.array(q_tree[self._place])
        for q_at, at, reference in self._roots:
            numbers[at[:3]] = q_tree[q_at : q_at + 3]
            numbers[at[3:]] = pin.log3(reference.T @ _rotation(q_tree, q_at))
        return numbers

    def step(self, q_tree: Array, numbers: Array) -> Array:
        """Return the tangent step of the independent coordinates from a configuration to chart numbers, shape (d,)."""
        step = numbers - q_tree[self._place]
        for q_at, at, reference in self._roots:
            start = pin.SE3(_rotation(q_tree, q_at), q_tree[q_at : q_at + 3])
            end = pin.SE3(reference @ pin.exp3(numbers[at[3:]]), numbers[at[:3]])
            step[at] = pin.log6(start.actInv(end)).vector
        return step

    def steps(self, q_trees: Array, numbers: Array) -> Array:
        """Return steps from several configurations, shape (k, d), with differences of chart numbers for rotations."""
        if self.is_trivial:
            return np.asarray(numbers - q_trees[:, self._place])
        return np.array([numbers - self.numbers(q_tree) for q_tree in q_trees])

    def rate(self, q_tree: Array, q_dot: Array) -> Array:
        """Return the rate of the chart numbers at the tangent velocity q_dot, shape (d,)."""
        if self.is_trivial:
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
