"""The state of a mechanism at one instant, of a simulator or of a recorded run."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["State", "recorded_state"]


class State(HasSummary):
    """State of a mechanism at one instant. It does not change when the simulator goes on; its arrays are read-only.

    `Simulator.step`, `Simulator.state` and `Run.sel` return states.

    Parameters
    ----------
    mechanism : Mechanism
    t : float
        Time, s.
    packed : (nq + 2 n + rows,) array
        q', the velocity, the velocity at which the terms are evaluated, and w, one after the other.
    q_indices, z_indices : list of int
        Independent and dependent coordinates of the terms, eq. 2.

    Attributes
    ----------
    mechanism : Mechanism
    t : float
        Time, s.
    """

    def __init__(
        self, mechanism: Mechanism, t: float, packed: Array, q_indices: list[int], z_indices: list[int]
    ) -> None:
        self.mechanism, self.t = mechanism, t
        self._packed, self._q_indices, self._z_indices = packed, q_indices, z_indices
        packed.setflags(write=False)

    def with_mechanism(self, mechanism: Mechanism) -> State:
        """Return this state for another instance of the same mechanism."""
        return State(mechanism, self.t, self._packed, self._q_indices, self._z_indices)

    def summary(self) -> Summary:
        """Return a one-screen summary: configuration, velocity, and w if it is not zero."""
        mechanism = self.mechanism
        tree = mechanism.tree
        rows: list[Row] = [
            ("q_tree", format_quantities(mechanism.coordinates, self.q_tree, tree.units())),
            ("v_tree", format_quantities(mechanism.coordinates, self.v_tree, tree.units("/s"))),
            ("independent q", ", ".join(mechanism.independent) or "none"),
        ]
        rows += [("w", f"up to {np.abs(self.w).max():.3g}")] if np.any(self.w) else []
        return Summary(f"State of {mechanism.name} at t = {self.t:g} s", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return time, coordinates and their rates as JSON-ready data."""
        return {
            "t": self.t,
            "coordinates": list(self.mechanism.coordinates),
            "q_tree": self.q_tree.tolist(),
            "v_tree": self.v_tree.tolist(),
            "w": self.w.tolist(),
        }

    @property
    def _q_tree(self) -> Array:
        return self._packed[: self.mechanism.tree.nq]  # Pinocchio's numbers: a free root has a quaternion

    @cached_property
    def v_tree(self) -> Array:
        """Rates by coordinate, shape (n,). A free root has velocity and angular velocity in its own axes.

        Off the constraint manifold, the SPF's z_dot differs from rho_z q_dot.
        """
        return self._velocity(0)

    @cached_property
    def w(self) -> Array:
        """Constraint residual phi, shape (rows,): zero except for the SPF started off its manifold."""
        return self._packed[self.mechanism.tree.nq + 2 * self.mechanism.n :]

    def _velocity(self, k: int) -> Array:
        start = self.mechanism.tree.nq + k * self.mechanism.n
        return self._packed[start : start + self.mechanism.n]

    @cached_property
    def terms(self) -> Terms:
        """Terms of the mechanism at this state. Each one is computed when it is first used."""
        mechanism = self.mechanism
        # Lists become arrays only here, because few callers of `Simulator.step` use the terms of every state.
        partition = Partition(np.array(self._q_indices, np.intp), np.array(self._z_indices, np.intp))
        at = Kinematics(mechanism.tree, mechanism.closure, partition, self._q_tree)
        return Terms(mechanism, at, self._velocity(1))

    @property
    def q_tree(self) -> Array:
        """Values by coordinate, in the order of `Mechanism.coordinates`, shape (n,)."""
        return self.mechanism.tree.to_coordinates(self._q_tree)

    @property
    def q(self) -> Array:
        """Independent coordinates, in the user's order, shape (d,)."""
        return self.mechanism.independent_part(self._q_tree)

    @property
    def q_dot(self) -> Array:
        """Rates of the independent coordinates, shape (d,). A free root has them in its own axes."""
        return self.v_tree[self.mechanism.partition.q]


def recorded_state(run: Run, k: int) -> State:
    """Return the state at the output instant k of a run, as a simulator would have it there."""
    mechanism = run.mechanism
    partition = mechanism.partition
    q_tree = mechanism.tree.from_coordinates(run.q_tree[k])
    v_terms = v_tree = run.v_tree[k]
    if np.any(run.w[k]) and run.scene["coriolis_velocity"] == "rho":
        v_terms = mechanism.kinematics(q_tree).rho @ v_tree[partition.q]  # eq. 8's C takes rho q_dot off the manifold
    packed = np.concatenate([q_tree, v_tree, v_terms, run.w[k]])
    return State(mechanism, float(run.t[k]), packed, partition.q.tolist(), partition.z.tolist())
