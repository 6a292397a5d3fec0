"""The judge: pieces of a motion integrated anew, finer and finer until two results agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853

from scripts.experiments.fuzz.joint_forces import JointForces
from scripts.experiments.fuzz.motion import LEAST_GAP, Motion
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import coordinates, difference, state

__all__ = ["Judge", "Judged"]

FINEST = 2e-12  # relative; below that two results differ by rounding
MOST_SUBSTEPS = 128
NUDGE = 1e-6  # relative
MAGNIFIED = 300.0  # times: such a piece is several of the motion's own times long, or meets what it nearly hits
MOST_TURN = 2.0  # rad, of a piece: angles are known within half a turn of where velocities lead
LARGEST = 1e12  # of an acceleration at rest
STAGES, WEIGHTS = DOP853.A, DOP853.B  # order 8, with fixed steps here


@dataclass(frozen=True)
class Judged:
    """What the judge says of P pieces: their ends (P, n), and which of them it could settle."""

    q: Array
    v: Array
    resolved: np.ndarray
    substeps: np.ndarray


class Judge:
    """The motion of one mechanism, integrated in absolute coordinates."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.motion = Motion(model)

    def pieces(self, q: Array, v: Array, dt: Array, target: float, drive: JointForces | None = None) -> Judged:
        """Where pieces (P, n) end after times (P,), to a relative target."""
        target = max(target, FINEST)
        with np.errstate(all="ignore"):
            return self._pieces(q, v, dt, target, drive)

    def _pieces(self, q: Array, v: Array, dt: Array, target: float, drive: JointForces | None) -> Judged:
        Y = state(self.model, q, v)
        near = q + v * dt[:, None]
        substeps = 1
        end, gap = self.integrate(Y, near, dt, substeps, drive)
        q_end, v_end = coordinates(self.model, end, near)
        resolved, used = np.zeros(len(q), bool), np.full(len(q), MOST_SUBSTEPS)
        while substeps < MOST_SUBSTEPS and not resolved.all():
            substeps *= 2
            open_ = ~resolved
            acting = None if drive is None else drive[open_]
            end, finer_gap = self.integrate(Y[open_], near[open_], dt[open_], substeps, acting)
            q_new, v_new = coordinates(self.model, end, near[open_])
            off = self.error(q_end[open_], v_end[open_], q_new, v_new)
            q_end[open_], v_end[open_], gap[open_] = q_new, v_new, finer_gap
            used[open_] = substeps
            resolved[open_] = off <= target
        turn = np.maximum(np.abs(v), np.abs(v_end)).max(axis=1) * dt
        return Judged(q_end, v_end, resolved & (gap > LEAST_GAP) & (turn < MOST_TURN), used)

    def sensitive(
        self, q: Array, v: Array, dt: Array, end: Judged, which: np.ndarray, drive: JointForces | None = None
    ) -> np.ndarray:
        """Which pieces, of some, magnify a small error of the velocity by more than they should within their time."""
        found = np.zeros(len(q), bool)
        at = np.flatnonzero(which & end.resolved)
        if len(at):
            acting = None if drive is None else drive[at]
            beside = self.pieces(q[at], v[at] * (1 + NUDGE), dt[at], FINEST, acting)  # as the loops allow
            found[at] = self.error(beside.q, beside.v, end.q[at], end.v[at]) > MAGNIFIED * NUDGE
        return found

    def error(self, q: Array, v: Array, q_right: Array, v_right: Array) -> Array:
        """Largest difference over the coordinates, relative to the largest right one or 1; the worse of q' and v'."""
        of_q = np.abs(difference(self.model, q, q_right)).max(axis=1) / np.maximum(1, np.abs(q_right).max(axis=1))
        of_v = np.abs(v - v_right).max(axis=1) / np.maximum(1, np.abs(v_right).max(axis=1))
        worse = np.maximum(of_q, of_v)
        return np.where(np.isfinite(worse), worse, np.inf)

    def integrate(
        self, Y: Array, near: Array, dt: Array, substeps: int, drive: JointForces | None = None
    ) -> tuple[Array, Array]:
        """States after times (P,) by steps of one length, and how near a loss of rank they came."""
        h = (dt / substeps)[:, None, None]
        least = np.full(len(Y), np.inf)
        K = np.empty((len(WEIGHTS), *Y.shape))
        for _ in range(substeps):
            for s in range(len(WEIGHTS)):
                at = Y + h * np.tensordot(STAGES[s, :s], K[:s], 1) if s else Y
                try:
                    K[s], gap = self.motion.rate(at, near, drive)
                except np.linalg.LinAlgError:
                    return np.full_like(Y, np.nan), np.zeros(len(Y))
                least = np.minimum(least, np.where(np.isfinite(gap), gap, 0.0))
            Y = Y + h * np.tensordot(WEIGHTS, K, 1)
        return Y, least

    def has_no_mass(self, q: Array) -> bool:
        """Whether some freedom moves no mass, so that nothing says how it is accelerated."""
        with np.errstate(all="ignore"):
            try:
                a, alpha, _ = self.motion.accelerations(state(self.model, q, np.zeros_like(q)), q)
            except np.linalg.LinAlgError:
                return True
        return not (np.isfinite(a).all() and np.abs(a).max() < LARGEST and np.abs(alpha).max() < LARGEST)
