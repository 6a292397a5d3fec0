"""Accelerations, loop forces and joint friction of recorded runs, reconstructed from what a run contains.

Eq. 1 gives the accelerations from the recorded motor torques at each output instant; nothing is interpolated between
output instants. The run's events tell which joints slid, stuck and touched stops.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.control.forces import body_wrenches, generalized_force
from ckc_pin.dynamics.formulations import dae_acceleration, multipliers, tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.run.run import Run

__all__ = ["Instant", "RecordedJoints", "compute_loop_forces", "compute_recorded_dynamics", "recorded_motion"]

# Singular values below this, relative to the largest, belong to joints whose holding forces depend on those of others.
HOLDING_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Instant:
    """State, acceleration and applied forces at one instant of a motion.

    Attributes
    ----------
    t : float
        s.
    terms : Terms
    acceleration : (n,) array
        Acceleration of the tree.
    tau : (motors,) array
        Recorded torques or preload; inverse dynamics adds the minimum-norm torques that are missing.
    other_force : (n,) array
        Generalized force of friction, stops and forces on links.
    link_wrenches : (joints, 6) array
        Wrenches of forces on links, see `body_wrenches`.
    """

    t: float
    terms: Terms
    acceleration: Array
    tau: Array
    other_force: Array
    link_wrenches: Array


def recorded_motion(run: Run) -> Iterator[Instant]:
    """Yield the instants of a run (InputError if its loops are open)."""
    if np.any(run.w[0]):
        raise InputError(
            f"{run.scene_name}: the run starts off phi = 0, with open loops; no forces in a closed mechanism produce "
            "its motion"
        )
    record = _Record(run)
    for k in range(len(run.t)):
        yield record.instant(k)


class _Record:
    """The instants of a run, with its accelerations by eq. 1."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.joints = RecordedJoints(run)

    def instant(self, k: int) -> Instant:
        """Return the k-th output instant (NumericalError if J has lost rank there)."""
        run, mechanism, t = self.run, self.run.mechanism, float(self.run.t[k])
        at = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[k]))
        terms = Terms(mechanism, at, run.v_tree[k])
        wrenches = body_wrenches(run.forces_at(k), t, terms)
        u_tree, other_force = mechanism.motors.force(run.tau[k]), generalized_force(wrenches, terms)
        correction = np.zeros(mechanism.closure.rows)
        if mechanism.prescribed:  # their motors overcome their friction
            accelerations, _ = run.prescribed_at(k)
            correction[mechanism.prescribed_rows] = -accelerations
            if self.joints.smoothing is None:
                at_joints = mechanism.prescribed_at
                other_force[at_joints] -= mechanism.joints.friction[at_joints] * np.sign(run.v_tree[k, at_joints])
        other_force += self.joints.force(k, terms, u_tree + other_force, correction)
        acceleration = dae_acceleration(terms, u_tree + other_force, correction)
        return Instant(t, terms, acceleration, run.tau[k], other_force, wrenches)


class RecordedJoints:
    """Generalized forces of dry friction and stops along a run, reconstructed from the run's events.

    Parameters
    ----------
    run : Run
    """

    def __init__(self, run: Run) -> None:
        mechanism = self.mechanism = run.mechanism
        self.smoothing = run.scene.get("friction_smoothing")
        sign, locked = np.zeros(mechanism.n), np.zeros(mechanism.n, dtype=bool)
        transitions = [event for event in run.events if event["of"] in ("friction", "stop")]
        self.sliding_signs: list[Array] = []
        self.locked: list[IntArray] = []
        for t in run.t:
            while transitions and transitions[0]["t"] <= t:
                event = transitions.pop(0)
                k, transition = mechanism.tree.index[event["coordinate"]], event["name"].rpartition(" ")[2]
                locked[k] = transition in ("sticks", "touches")
                sign[k] = event["direction"] if transition == "slides" else 0.0 if locked[k] else sign[k]
            self.sliding_signs.append(sign.copy())
            self.locked.append(np.flatnonzero(locked))

    def force(self, k: int, terms: Terms, u_tree: Array, correction: Array | float = 0.0) -> Array:
        """Return the force of friction and stops on the tree at output instant k, shape (n,), N or N m.

        Joints that stick or touch a stop have the minimum-norm forces that keep them at rest.

        Parameters
        ----------
        k : int
        terms : Terms
            At the instant.
        u_tree : (n,) array
            All other applied forces u'.
        correction : (rows,) array, optional
            Minus the acceleration of the constraint rows.
        """
        joints = self.mechanism.joints
        if self.smoothing is not None:
            return joints.smooth_friction(terms.v_tree, self.smoothing)
        force = -joints.friction * self.sliding_signs[k]
        locked = self.locked[k]
        if not len(locked):
            return force
        tangent, _ = tangent_basis(terms, np.zeros(self.mechanism.closure.rows))
        inertia = Factorization(tangent.T @ terms.D_tree @ tangent)
        locked_tangent = tangent[locked]
        responses = locked_tangent @ np.column_stack([inertia.solve(row) for row in locked_tangent])
        acceleration = dae_acceleration(terms, u_tree + force, correction)[locked]
        force[locked] -= np.linalg.lstsq(responses, acceleration, rcond=HOLDING_RANK_TOLERANCE)[0]
        return force


def compute_loop_forces(run: Run) -> dict[str, Array]:
    """Return the multipliers of eq. 1 along a run by loop; see `Run.loop_forces`."""
    _, forces = compute_recorded_dynamics(run)
    loops = [loop for loop, _ in run.mechanism.closure.names]
    return {loop: forces[:, [name == loop for name in loops]] for loop in dict.fromkeys(loops)}


def compute_recorded_dynamics(run: Run) -> tuple[Array, Array]:
    """Return the accelerations of the tree and the multipliers of eq. 1 at a run's output instants.

    They follow from the recorded state and motor torques, and from the friction and stops of the run's events.

    Parameters
    ----------
    run : Run

    Returns
    -------
    a_tree : (m, n) array
        Time derivative of v'.
    multipliers : (m, rows) array
        Both are NaN where J has lost rank.
    """
    record = _Record(run)
    accelerations, forces = np.full_like(run.v_tree, np.nan), np.full_like(run.phi, np.nan)
    for k in range(len(run.t)):
        with suppress(NumericalError):
            instant = record.instant(k)
            u_tree = run.mechanism.motors.force(instant.tau) + instant.other_force
            forces[k] = multipliers(instant.terms, u_tree, instant.acceleration)
            accelerations[k] = instant.acceleration
    return accelerations, forces
