"""Quantities of a run that follow from its recorded rows. Each array is computed at its first use."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["DerivedQuantities", "RunQuantities"]


class DerivedQuantities:
    """Arrays along a run that `ckc_pin.run.columns` gives names to; a row is an output instant.

    Parameters
    ----------
    t, q_tree, v_tree : arrays
        Times, coordinates and rates of the tree.
    mechanism : Mechanism
    """

    def __init__(self, t: Array, q_tree: Array, v_tree: Array, mechanism: Mechanism) -> None:
        self.t, self.q_tree, self.v_tree, self.mechanism = t, q_tree, v_tree, mechanism

    @cached_property
    def point_positions(self) -> Array:
        """World coordinates of the named points, shape (m, 3 points), m."""
        return self._evaluate_points(lambda q, _: np.hstack([*self.mechanism.point_positions(q).values()]))

    @cached_property
    def point_velocities(self) -> Array:
        """Velocities of the named points in the world, shape (m, 3 points), m/s."""
        return self._evaluate_points(lambda q, v: np.vstack([*self.mechanism.point_jacobians(q).values()]) @ v)

    def _evaluate_points(self, evaluate: Callable[[Array, Array], Array]) -> Array:
        values = np.empty((len(self.t), 3 * len(self.mechanism.points)))
        if values.size:
            for k, (numbers, v_tree) in enumerate(zip(self.q_tree, self.v_tree, strict=True)):
                values[k] = evaluate(self.mechanism.tree.from_coordinates(numbers), v_tree)
        return values

    @cached_property
    def kinetic_energy(self) -> Array:
        """Kinetic energy, shape (m,), J."""
        return self._evaluate(lambda terms: 0.5 * float(terms.v_tree @ terms.D_tree @ terms.v_tree))

    @cached_property
    def potential_energy(self) -> Array:
        """Potential energy of gravity, springs and constant forces, shape (m,), J."""
        return self._evaluate(lambda terms: terms.potential_energy)

    @cached_property
    def sigma_min(self) -> Array:
        """Smallest singular value of phi_z for the mechanism's independent coordinates, shape (m,)."""
        return self._evaluate(lambda terms: terms.at.sigma_min())

    @property
    def energy(self) -> Array:
        """Kinetic and potential energy, shape (m,), J."""
        return self.kinetic_energy + self.potential_energy

    def _evaluate(self, evaluate: Callable[[Terms], float]) -> Array:
        tree = self.mechanism.tree
        states = zip(self.q_tree, self.v_tree, strict=True)
        at = self.mechanism.kinematics
        return np.array([evaluate(Terms(self.mechanism, at(tree.from_coordinates(q)), v)) for q, v in states])


class RunQuantities(DerivedQuantities):
    """Derived quantities of a `Run`, with those that need its forces, its controller and its events."""

    def __init__(self, run: Run) -> None:
        super().__init__(run.t, run.q_tree, run.v_tree, run.mechanism)
        self._run = run

    @property
    def phi_max(self) -> Array:
        """Largest |phi - w| over the constraint rows, shape (m,)."""
        return np.abs(self._run.phi - self._run.w).max(axis=1, initial=0.0)

    @property
    def desired_dot(self) -> Array | None:
        """Desired rates of the independent coordinates, shape (m, d); None without a desired motion."""
        path = self._run.desired_path
        return None if path is None else path.q_dot

    @property
    def a_tree(self) -> Array:
        """Accelerations by coordinate, the time derivative of v', shape (m, n).

        Raises
        ------
        InputError
            The run starts off its constraint manifold.
        """
        if np.any(self._run.w[:1]):
            raise InputError(
                f"{self._run.scene_name}: the run starts off phi = 0, where eq. 1 does not give its accelerations"
            )
        return self._dynamics[0]

    @property
    def multipliers(self) -> Array:
        """Multipliers of eq. 1 by constraint row, shape (m, rows), N or N m; NaN where J has lost rank."""
        return self._dynamics[1]

    @cached_property
    def _dynamics(self) -> tuple[Array, Array]:
        from ckc_pin.run.recorded import compute_recorded_dynamics  # which uses runs

        return compute_recorded_dynamics(self._run)

    @cached_property
    def joint_wrenches(self) -> Array:
        """Wrenches that the joints transmit, shape (m, 6 joints), N and N m; NaN after a singular instant."""
        from ckc_pin.run.inverse import inverse_dynamics  # which uses runs

        forces = inverse_dynamics(self._run)
        wrenches = np.full((len(self.t), 6 * len(forces.joint_forces)), np.nan)
        wrenches[: len(forces.t)] = np.hstack([np.zeros((len(forces.t), 0)), *forces.joint_forces.values()])
        return wrenches
