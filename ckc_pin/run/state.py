"""The `State` of a mechanism at an instant, of a simulator or of a run."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.summary import state_summary

__all__ = ["State"]


class State(HasSummary):
    """Where a simulator is, or a run was. It stays as it is when the simulator goes on; its arrays are read-only.

    Attributes
    ----------
    mechanism : Mechanism
    t : float
        Time, s.
    """

    def __init__(self, mechanism: Mechanism, t: float, numbers: Array, q: list[int], z: list[int]) -> None:
        self.mechanism, self._numbers, self._q, self._z = mechanism, numbers, q, z
        self.t = t
        numbers.setflags(write=False)

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return state_summary(self)

    @cached_property
    def _q_tree(self) -> Array:
        return self._numbers[: self.mechanism.tree.nq]

    @cached_property
    def v_tree(self) -> Array:
        """Rates by coordinate, shape (n,); of a free root velocity and angular velocity in its own axes.

        Off its manifold the SPF's z_dot differs from what q_dot implies.
        """
        return self._part(0)

    @cached_property
    def _v_terms(self) -> Array:
        return self._part(1)

    @cached_property
    def w(self) -> Array:
        """What phi is, shape (rows,): zero but for the SPF started off its manifold."""
        return self._numbers[self.mechanism.tree.nq + 2 * self.mechanism.n :]

    def _part(self, k: int) -> Array:
        start = self.mechanism.tree.nq + k * self.mechanism.n
        return self._numbers[start : start + self.mechanism.n]

    @cached_property
    def terms(self) -> Terms:
        """Every term of the mechanism at this state, each computed when first asked for."""
        mechanism = self.mechanism
        partition = Partition(np.array(self._q, np.intp), np.array(self._z, np.intp))
        return Terms(mechanism, Kinematics(mechanism.tree, mechanism.closure, partition, self._q_tree), self._v_terms)

    @property
    def q_tree(self) -> Array:
        """Values by coordinate, in the order of `coordinates`, shape (n,)."""
        return self.mechanism.tree.to_coordinates(self._q_tree)

    @property
    def q(self) -> Array:
        """The independent ones, in the user's order, shape (d,)."""
        return self.mechanism.independent_part(self._q_tree)

    @property
    def q_dot(self) -> Array:
        """Their rates, shape (d,); of a free root in its own axes."""
        return self.v_tree[self.mechanism.partition.q]
