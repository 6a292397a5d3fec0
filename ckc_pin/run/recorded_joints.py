"""What dry friction and stops did to a recorded motion: its events tell who slid, stuck and touched when."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.dynamics.formulations import dae_acceleration, multipliers, tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.run.run import Run

__all__ = ["RecordedJoints", "loop_forces"]

IDLE = 1e-9  # of the forces that hold: what follows from others, of least norm


class RecordedJoints:
    """Forces of friction and stops along a run.

    Parameters
    ----------
    run : Run
    """

    def __init__(self, run: Run) -> None:
        mechanism = self.mechanism = run.mechanism
        self.smoothing = run.scene.get("friction_smoothing")
        sign, locked = np.zeros(mechanism.n), np.zeros(mechanism.n, dtype=bool)
        changes = [event for event in run.events if event["of"] in ("friction", "stop")]
        self.sign, self.locked = [], []
        for t in run.t:
            while changes and changes[0]["t"] <= t:
                event = changes.pop(0)
                k, what = mechanism.tree.index[event["coordinate"]], event["name"].rpartition(" ")[2]
                locked[k] = what in ("sticks", "touches")
                sign[k] = event["direction"] if what == "slides" else 0.0 if locked[k] else sign[k]
            self.sign.append(sign.copy())
            self.locked.append(np.flatnonzero(locked))

    def __call__(self, k: int, terms: Terms, u_tree: Array) -> Array:
        """Return the force on the tree at output instant k beside u', shape (n,), N or N m.

        Of joints that stick or touch: what keeps them at rest, the least such forces where others would do too.
        """
        joints = self.mechanism.joints
        if self.smoothing is not None:
            return joints.smooth_friction(terms.v_tree, self.smoothing)
        force = -joints.friction * self.sign[k]
        at = self.locked[k]
        if not len(at):
            return force
        tangent, _ = tangent_basis(terms, np.zeros(self.mechanism.closure.rows))
        inertia = Factorization(tangent.T @ terms.D_tree @ tangent)
        grip = tangent[at]
        responses = grip @ np.column_stack([inertia.solve(row) for row in grip])
        moved = dae_acceleration(terms, u_tree + force)[at]
        force[at] -= np.linalg.lstsq(responses, moved, rcond=IDLE)[0]
        return force


def loop_forces(run: Run) -> dict[str, Array]:
    """Return the multipliers of eq. 1 along a run by loop; see `Run.loop_forces`."""
    mechanism, of_joints = run.mechanism, RecordedJoints(run)
    forces = np.empty_like(run.phi)
    for k, numbers in enumerate(run.q_tree):
        at = mechanism.kinematics(mechanism.tree.from_coordinates(numbers))
        terms = Terms(mechanism, at, run.v_tree[k])
        u_tree = mechanism.motors.force(run.tau[k])
        try:
            u_tree += of_joints(k, terms, u_tree)
            forces[k] = multipliers(terms, u_tree, dae_acceleration(terms, u_tree))
        except NumericalError:
            forces[k] = np.nan
    loops = [loop for loop, _ in mechanism.closure.names]
    return {loop: forces[:, [x == loop for x in loops]] for loop in dict.fromkeys(loops)}
