"""What a set-point controller does to the joints: eq. 14 read anew, its constant h(q_d) from the rows of the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.read import Model, NoJudge
from scripts.experiments.fuzz.spatial import Array, IntArray

__all__ = ["PER_SAMPLE", "JointForces", "Unlike", "joint_forces"]

PER_SAMPLE = 10  # output instants from one sample to the next; delays are multiples of one
ROUNDING = 1e-9  # relative
FAR = 1.0  # rad, of a joint between two samples: pieces are shorter then


class Unlike(Exception):
    """The u of a run is not what its controller gives."""


@dataclass(frozen=True)
class JointForces:
    """Forces along joints for P pieces: base - K_P value - K_V rate, within a limit; base is (P, d)."""

    columns: IntArray
    base: Array
    K_P: float = 0.0
    K_V: float = 0.0
    limit: float = np.inf

    def __getitem__(self, pieces: np.ndarray) -> JointForces:
        """The efforts of some pieces."""
        return JointForces(self.columns, self.base[pieces], self.K_P, self.K_V, self.limit)

    def along(self, value: Array, rate: Array) -> Array:
        """Forces (P, d) at the joints' values and rates."""
        return np.clip(self.base - self.K_P * value - self.K_V * rate, -self.limit, self.limit)


def joint_forces(
    controller: Mapping[str, Any], model: Model, run: Run, output_dt: float
) -> tuple[IntArray, JointForces]:
    """Rows of a run between which u has no jump, and what acts from each of them to the next.

    Raises
    ------
    NoJudge
        Limited actuators that are not the independent coordinates.
    Unlike
        Rows whose u is not eq. 14's.
    """
    columns = np.array([model.labels.index(name) for name in run.independent], np.intp)
    at = [run.coordinates.index(name) for name in run.independent]
    target = np.array([controller["q_d"][name] for name in run.independent])
    K_P, K_V, limit = controller["K_P"], controller["K_V"], controller.get("torque_limit", np.inf)
    if np.isfinite(limit) and run.actuated != run.independent:
        raise NoJudge("limited actuators that are not the independent coordinates")
    feedback = K_P * (target - run.q_tree[:, at]) - K_V * run.v_tree[:, at]
    rows = np.arange(len(run.t))
    if "sample_time" not in controller:
        h = _constant(run.u, feedback, limit)
        _compare(run.u, feedback, h, limit)
        if np.isnan(h).any():
            raise NoJudge("a limit that cuts at every instant")
        return rows, JointForces(columns, np.tile(h + K_P * target, (len(rows), 1)), K_P, K_V, limit)
    late = round(controller.get("delay", 0.0) / output_dt)
    changes = (rows >= late) & ((rows - late) % PER_SAMPLE == 0)  # at such a row u may be the old or the new one
    if run.u[: min(late, len(rows))].any():
        raise Unlike("u acts before its delay is over")
    steady = rows[~changes & (rows > late)]
    seen = feedback[(steady - late) // PER_SAMPLE * PER_SAMPLE]
    _compare(run.u[steady], seen, _constant(run.u[steady], seen, limit), limit)
    far = np.abs(run.v_tree).max(axis=1) * PER_SAMPLE * output_dt > FAR
    ends = np.union1d(rows[changes | far], [0, rows[-1]])
    return ends, JointForces(columns, run.u[np.where(changes, np.minimum(rows + 1, rows[-1]), rows)[ends]])


def _constant(u: Array, feedback: Array, limit: float) -> Array:
    """h(q_d) from rows that the limit does not cut, NaN where there are none."""
    free = np.where(np.abs(u) < limit, u - feedback, np.nan)
    some = ~np.isnan(free).all(axis=0) if len(u) else np.zeros(u.shape[1], bool)
    h = np.full(u.shape[1], np.nan)
    h[some] = np.nanmedian(free[:, some], axis=0)
    return h


def _compare(u: Array, feedback: Array, h: Array, limit: float) -> None:
    if np.abs(u).max(initial=0.0) > limit:
        raise Unlike(f"u is beyond its limit: {np.abs(u).max():.17g}")
    known = ~np.isnan(h)
    off = np.abs(u - np.clip(feedback + h, -limit, limit))[:, known].max(initial=0.0)
    if off > ROUNDING * max(np.abs(feedback).max(initial=0.0), np.abs(u).max(initial=0.0)):
        raise Unlike(f"u is off eq. 14 by {off:.2g}")
