"""Joint forces of a set-point controller, by an independent implementation of eq. 14.

The constant h(q_d) is estimated from the rows of the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.read import Model, UnsupportedMechanism
from scripts.experiments.fuzz.spatial import Array, IntArray

__all__ = ["PER_SAMPLE", "ControlMismatch", "JointForces", "read_joint_forces"]

PER_SAMPLE = 10  # output instants per sample; delays are whole numbers of output instants
ROUNDING = 1e-9  # relative
MAX_ROTATION_RAD = 1.0  # of a joint between two samples; segments are shorter where it is exceeded


class ControlMismatch(Exception):
    """The u of a run contradicts its control law."""


@dataclass(frozen=True)
class JointForces:
    """Joint forces for P segments: base - K_P value - K_V rate, clipped at a limit; base is (P, d)."""

    columns: IntArray
    base: Array
    K_P: float = 0.0
    K_V: float = 0.0
    limit: float = np.inf

    def __getitem__(self, segments: np.ndarray) -> JointForces:
        """Return the joint forces of selected segments."""
        return JointForces(self.columns, self.base[segments], self.K_P, self.K_V, self.limit)

    def evaluate(self, value: Array, rate: Array) -> Array:
        """Return forces (P, d) at the joints' values and rates."""
        return np.clip(self.base - self.K_P * value - self.K_V * rate, -self.limit, self.limit)


def read_joint_forces(
    controller: Mapping[str, Any], model: Model, run: Run, output_dt: float
) -> tuple[IntArray, JointForces]:
    """Return rows of a run between which u does not jump, and the joint forces from each of them to the next.

    Raises
    ------
    UnsupportedMechanism
        A torque limit applies to actuators other than the independent coordinates, or u is at its limit in all rows.
    ControlMismatch
        The u of a row differs from eq. 14.
    """
    columns = np.array([model.labels.index(name) for name in run.independent], np.intp)
    at = [run.coordinates.index(name) for name in run.independent]
    target = np.array([controller["q_d"][name] for name in run.independent])
    K_P, K_V, limit = controller["K_P"], controller["K_V"], controller.get("torque_limit", np.inf)
    if np.isfinite(limit) and run.actuated != run.independent:
        raise UnsupportedMechanism("a torque limit on actuators other than the independent coordinates")
    feedback = K_P * (target - run.q_tree[:, at]) - K_V * run.v_tree[:, at]
    rows = np.arange(len(run.t))
    if "sample_time" not in controller:
        h = _estimate_constant(run.u, feedback, limit)
        _check_control_law(run.u, feedback, h, limit)
        if np.isnan(h).any():
            raise UnsupportedMechanism("u is at its torque limit in all rows")
        return rows, JointForces(columns, np.tile(h + K_P * target, (len(rows), 1)), K_P, K_V, limit)
    delay_rows = round(controller.get("delay", 0.0) / output_dt)
    may_jump = (rows >= delay_rows) & (
        (rows - delay_rows) % PER_SAMPLE == 0
    )  # u of such a row may be from before or after the jump
    if run.u[: min(delay_rows, len(rows))].any():
        raise ControlMismatch("u is not zero before the delay has elapsed")
    steady = rows[~may_jump & (rows > delay_rows)]
    sampled = feedback[(steady - delay_rows) // PER_SAMPLE * PER_SAMPLE]
    _check_control_law(run.u[steady], sampled, _estimate_constant(run.u[steady], sampled, limit), limit)
    is_fast = np.abs(run.v_tree).max(axis=1) * PER_SAMPLE * output_dt > MAX_ROTATION_RAD
    ends = np.union1d(rows[may_jump | is_fast], [0, rows[-1]])
    return ends, JointForces(columns, run.u[np.where(may_jump, np.minimum(rows + 1, rows[-1]), rows)[ends]])


def _estimate_constant(u: Array, feedback: Array, limit: float) -> Array:
    """Return h(q_d) estimated from rows below the torque limit; NaN for coordinates without such rows."""
    free = np.where(np.abs(u) < limit, u - feedback, np.nan)
    has_free_rows = ~np.isnan(free).all(axis=0) if len(u) else np.zeros(u.shape[1], bool)
    h = np.full(u.shape[1], np.nan)
    h[has_free_rows] = np.nanmedian(free[:, has_free_rows], axis=0)
    return h


def _check_control_law(u: Array, feedback: Array, h: Array, limit: float) -> None:
    if np.abs(u).max(initial=0.0) > limit:
        raise ControlMismatch(f"u exceeds its limit: {np.abs(u).max():.17g}")
    finite = ~np.isnan(h)
    error = np.abs(u - np.clip(feedback + h, -limit, limit))[:, finite].max(initial=0.0)
    if error > ROUNDING * max(np.abs(feedback).max(initial=0.0), np.abs(u).max(initial=0.0)):
        raise ControlMismatch(f"u is off eq. 14 by {error:.2g}")
