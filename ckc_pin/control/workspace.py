"""Whether a desired trajectory stays where the mechanism can follow: inside, and away from singularity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ckc_pin.control.desired import Desired, cycles
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["DesiredCheck", "follow_desired", "leaving"]

SAMPLES, OF_A_CYCLE = 1000, 32  # at least so many, and of the quickest wave: a straight way between two is off by 0.5 %
MOST = 10_000  # samples: seconds
CANDIDATES = 5  # places where the margin may be least
REFINEMENTS = 50  # bisections: to 1e-15 of a sample interval


@dataclass(frozen=True)
class DesiredCheck:
    """What happens along a desired trajectory.

    Attributes
    ----------
    leaves_at : float or None
        When it leaves the workspace (of its assembly branch), s.
    closest_t : float
        When it comes closest to a singular configuration; `leaves_at` when it leaves.
    sigma_min : float
        Smallest singular value of phi_z then; on the edge of the workspace it is zero.
    until : float
        How far it was followed, s: to its end, or as far as ten thousand samples go along quick waves. Infinite of
        a set point.
    """

    leaves_at: float | None
    closest_t: float
    sigma_min: float
    until: float = np.inf


def follow_desired(
    mechanism: Mechanism, desired: Desired, t_end: float, start: Kinematics | None = None
) -> DesiredCheck:
    """Follow sigma(q_d(t)) over a run, on the branch of `start`, and find where it comes closest to a singularity."""
    samples = max(SAMPLES, int(np.ceil(OF_A_CYCLE * min(cycles(desired, t_end), MOST))))
    times = np.linspace(0.0, t_end, samples + 1)[: MOST + 1]
    first = sigma(mechanism, desired(0.0)[0], start)
    if first.verdict != "converged":
        return DesiredCheck(0.0, 0.0, 0.0, 0.0)
    at, t_at = first.at, 0.0
    way = [(0.0, at.sigma_min(), at)]
    for t in times[1:]:
        moved = _move(mechanism, at, desired, float(t))
        if moved is None:
            return leaving(mechanism, desired, at, t_at, float(t))
        at, t_at = moved, float(t)
        way.append((t_at, at.sigma_min(), at))
    return _closest(mechanism, desired, way)


def _move(
    mechanism: Mechanism, at: Kinematics, desired: Desired, t: float, *, anywhere: bool = True
) -> Kinematics | None:
    try:
        q = desired(t)[0]
    except NumericalError:  # a point's path has no q outside the workspace
        return None
    outcome = sigma(mechanism, q, at, anywhere=anywhere)
    return outcome.at if outcome.verdict == "converged" else None


def leaving(mechanism: Mechanism, desired: Desired, at: Kinematics, inside: float, outside: float) -> DesiredCheck:
    """Bisect for the last instant that can be reached, along the way: within a sample nothing is behind a gap."""
    for _ in range(REFINEMENTS):
        middle = 0.5 * (inside + outside)
        moved = _move(mechanism, at, desired, middle, anywhere=False)
        if moved is None:
            outside = middle
        else:
            inside, at = middle, moved
    return DesiredCheck(inside, inside, at.sigma_min(), inside)


def _closest(mechanism: Mechanism, desired: Desired, way: list[tuple[float, float, Kinematics]]) -> DesiredCheck:
    """Look between samples where the margin is least: there the motion may also be outside for a moment."""
    margins = np.array([margin for _, margin, _ in way])
    around = np.concatenate([[np.inf], margins, [np.inf]])
    lows = np.flatnonzero((margins <= around[:-2]) & (margins <= around[2:]))
    lowest = lows[np.argsort(margins[lows], kind="stable")][:CANDIDATES]
    finer = [_around(mechanism, desired, way, int(k)) for k in lowest]
    if any(found.leaves_at is not None for found in finer):
        every = (_around(mechanism, desired, way, int(k)) for k in lows)
        return next(found for found in every if found.leaves_at is not None)
    least = min(finer, key=lambda found: found.sigma_min)
    return replace(least, until=way[-1][0])


def _around(mechanism: Mechanism, desired: Desired, way: list[tuple[float, float, Kinematics]], k: int) -> DesiredCheck:
    """Look between a sample's two neighbours."""
    from scipy.optimize import minimize_scalar

    (t, margin, at), near, outside = way[k], way[max(k - 1, 0) : k + 2], []

    def margin_at(time: float) -> float:
        moved = _move(mechanism, at, desired, time, anywhere=False)
        if moved is None:
            outside.append(time)
        return 0.0 if moved is None else moved.sigma_min()

    finer = minimize_scalar(margin_at, bounds=(near[0][0], near[-1][0]), method="bounded", options={"xatol": 1e-9})
    if outside:
        before = [sample for sample in near if sample[0] < min(outside)][-1]
        return leaving(mechanism, desired, before[2], before[0], min(outside))
    margin, t = min((margin, t), (float(finer.fun), float(finer.x)))
    return DesiredCheck(None, t, margin)
