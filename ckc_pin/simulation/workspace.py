"""Whether a desired trajectory stays where the mechanism can follow: inside, and away from singularity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.control.desired import Desired
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["DesiredCheck", "follow_desired", "leaving"]

SAMPLES = 1000
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
    """

    leaves_at: float | None
    closest_t: float
    sigma_min: float


def follow_desired(mechanism: Mechanism, desired: Desired, t_end: float) -> DesiredCheck:
    """Follow sigma(q_d(t)) over a run and find where it comes closest to a singular configuration."""
    times = np.linspace(0.0, t_end, SAMPLES + 1)
    first = sigma(mechanism, desired(0.0)[0])
    if first.verdict != "converged":
        return DesiredCheck(0.0, 0.0, 0.0)
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
    return DesiredCheck(inside, inside, at.sigma_min())


def _closest(mechanism: Mechanism, desired: Desired, way: list[tuple[float, float, Kinematics]]) -> DesiredCheck:
    from scipy.optimize import minimize_scalar

    k = int(np.argmin([margin for _, margin, _ in way]))
    t, margin, at = way[k]
    low, high = way[max(k - 1, 0)][0], way[min(k + 1, len(way) - 1)][0]

    def margin_at(time: float) -> float:
        moved = _move(mechanism, at, desired, time)
        return 0.0 if moved is None else moved.sigma_min()

    finer = minimize_scalar(margin_at, bounds=(low, high), method="bounded", options={"xatol": 1e-9})
    if finer.fun < margin:
        t, margin = float(finer.x), float(finer.fun)
    return DesiredCheck(None, t, margin)
