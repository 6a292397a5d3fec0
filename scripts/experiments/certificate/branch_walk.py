"""Move along one assembly branch, measure its distance from singularity, and minimize values on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.sigma import follow_sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "Border",
    "Height",
    "find_minimum",
    "follow",
    "margin",
    "margin_gradient",
    "same_configuration",
    "wrapped_difference",
]

MIN_GAIN = 1e-5  # relative; a step of the search for a minimum has to lower the value by this much
MIN_STEP_FRACTION = 1e-2  # of the first step; the search ends there
MARGIN_TOLERANCE = 1e-9  # relative; of a configuration on the border
MAX_CORRECTIONS = 8  # to reach the border

Height = Callable[[Kinematics], float]


def margin(at: Kinematics) -> float:
    """Return |s|, the volume spanned by the columns of phi_z over the product of their lengths: 0 (singular) to 1.

    With square phi_z it is |det phi_z| over the columns' lengths; for the five-bar |det phi_z| / (l2 l4), the
    sine of the angle between the distal links.
    """
    if not len(at.partition.z):
        return 1.0
    columns = at.phi_z / np.linalg.norm(at.phi_z, axis=0)
    return float(np.prod(np.linalg.svd(columns, compute_uv=False)))


def margin_gradient(at: Kinematics) -> Array:
    """Return d|s|/dq along the branch, shape (d,), from d(log volume) = tr(phi_z^+ dphi_z)."""
    z = at.partition.z
    size = np.sum(at.phi_z**2, axis=0)
    slopes = []
    for column in at.rho.T:
        change = at.J_dot(column)[:, z]
        slopes.append(np.trace(at.phi_z_factor.solve(change)) - np.sum(np.sum(at.phi_z * change, axis=0) / size))
    return margin(at) * np.array(slopes)


def follow(mechanism: Mechanism, at: Kinematics, dq: Array) -> tuple[Kinematics, float]:
    """Move q by dq along the branch; return the configuration reached and the fraction of dq covered."""
    moved = follow_sigma(at, dq, 0.0, mechanism.tolerance, anywhere=False)
    return moved.at, moved.reached


def wrapped_difference(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> Array:
    """Return the difference in q of two configurations, with angles wrapped into [-pi, pi), shape (d,)."""
    return _without_turns(mechanism, a, b)[mechanism.partition.q]


def same_configuration(mechanism: Mechanism, a: Kinematics, b: Kinematics, tolerance: float = 1e-6) -> bool:
    """Return whether two configurations differ by full turns only."""
    return bool(np.abs(_without_turns(mechanism, a, b)).max(initial=0.0) < tolerance)


def _without_turns(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> Array:
    gap = mechanism.tree.to_coordinates(b.q_tree) - mechanism.tree.to_coordinates(a.q_tree)
    angles = ~mechanism.tree.in_metres
    gap[angles] = np.remainder(gap[angles] + np.pi, 2 * np.pi) - np.pi
    return gap


@dataclass(frozen=True)
class Border:
    """Border |s| = s_min. It accepts configurations on one side, and projects configurations of the other side onto it.

    Attributes
    ----------
    mechanism : Mechanism
    s_min : float
    accepts_singular_side : bool
        Whether configurations with |s| <= s_min are accepted, or with |s| >= s_min.
    """

    mechanism: Mechanism
    s_min: float
    accepts_singular_side: bool = False

    def __call__(self, at: Kinematics) -> Kinematics | None:
        """Return the configuration, or one on the border, or None if the border cannot be reached."""
        sign = -1.0 if self.accepts_singular_side else 1.0
        for _ in range(MAX_CORRECTIONS):
            gap = self.s_min - margin(at)
            if sign * gap <= MARGIN_TOLERANCE * self.s_min:
                return at
            slope = margin_gradient(at)
            at, reached = follow(self.mechanism, at, (gap + sign * 1e-10 * self.s_min) * slope / (slope @ slope))
            if reached < 1.0:
                return at if self.accepts_singular_side else None
        return None


def find_minimum(
    mechanism: Mechanism,
    start: Kinematics,
    value: Height,
    step: Array,
    admit: Callable[[Kinematics], Kinematics | None],
) -> Kinematics:
    """Minimize a value by coordinate descent with shrinking steps; return the configuration of the minimum.

    Parameters
    ----------
    mechanism : Mechanism
    start : Kinematics
    value : callable
        Of a configuration, to be minimized.
    step : (d,) array
        Longest step, rad or m.
    admit : callable
        Returns an allowed configuration for a trial, or None.
    """
    at, low, scale = start, value(start), 0.5
    while scale > MIN_STEP_FRACTION:
        for k in range(2 * mechanism.d):
            dq = np.zeros(mechanism.d)
            dq[k // 2] = scale * step[k // 2] * (1 if k % 2 else -1)
            there = admit(follow(mechanism, at, dq)[0])
            if there is not None and (reached := value(there)) < low - MIN_GAIN * abs(low):
                at, low = there, reached
                break
        else:
            scale /= 2
    return at
