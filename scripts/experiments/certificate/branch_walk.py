"""Small moves on one assembly branch: along sigma, measured by how far from singular they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.sigma import follow_sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Border", "Height", "follow", "least", "margin", "margin_gradient", "same_configuration", "way"]

GAIN = 1e-5  # of the value: what a move of the search for a least value has to gain
FINEST = 1e-2  # of its first step: where that search ends

Height = Callable[[Kinematics], float]


def margin(at: Kinematics) -> float:
    """|s|: the volume spanned by the columns of phi_z over the product of their lengths, 1 at best, 0 where singular.

    With square phi_z it is |det phi_z| over the columns' lengths; for the five-bar |det phi_z| / (l2 l4), the
    sine of the angle between the distal links.
    """
    if not len(at.partition.z):
        return 1.0
    columns = at.phi_z / np.linalg.norm(at.phi_z, axis=0)
    return float(np.prod(np.linalg.svd(columns, compute_uv=False)))


def margin_gradient(at: Kinematics) -> Array:
    """d |s| / d q along the branch, shape (d,): the logarithm of a volume changes by the trace of phi_z^+ dphi_z."""
    z = at.partition.z
    size = np.sum(at.phi_z**2, axis=0)
    slopes = []
    for column in at.rho.T:
        change = at.J_dot(column)[:, z]
        slopes.append(np.trace(at.phi_z_factor.solve(change)) - np.sum(np.sum(at.phi_z * change, axis=0) / size))
    return margin(at) * np.array(slopes)


def follow(mechanism: Mechanism, at: Kinematics, dq: Array) -> tuple[Kinematics, float]:
    """Move q by dq along the branch; return where that led and how much of the way it was, 1 for all of it."""
    moved = follow_sigma(at, dq, 0.0, mechanism.tolerance, anywhere=False)
    return moved.at, moved.reached


def way(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> Array:
    """Return the shortest way in q from one configuration to another, whole turns left out, shape (d,)."""
    return _without_turns(mechanism, a, b)[mechanism.partition.q]


def same_configuration(mechanism: Mechanism, a: Kinematics, b: Kinematics, tolerance: float = 1e-6) -> bool:
    """Whether two configurations differ by whole turns at most."""
    return bool(np.abs(_without_turns(mechanism, a, b)).max(initial=0.0) < tolerance)


def _without_turns(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> Array:
    gap = mechanism.tree.to_coordinates(b.q_tree) - mechanism.tree.to_coordinates(a.q_tree)
    angles = ~mechanism.tree.in_metres
    gap[angles] = np.remainder(gap[angles] + np.pi, 2 * np.pi) - np.pi
    return gap


@dataclass(frozen=True)
class Border:
    """Admits configurations on one side of |s| = s_min, and puts those on the other side on it, across it.

    Attributes
    ----------
    mechanism : Mechanism
    s_min : float
    near : bool
        Whether the side next to the singular configuration is the admitted one.
    """

    mechanism: Mechanism
    s_min: float
    near: bool = False

    def __call__(self, at: Kinematics) -> Kinematics | None:
        """Return an admitted configuration, or None when there is no way to one."""
        sign = -1.0 if self.near else 1.0
        for _ in range(8):
            gap = self.s_min - margin(at)
            if sign * gap <= 1e-9 * self.s_min:
                return at
            slope = margin_gradient(at)
            at, reached = follow(self.mechanism, at, (gap + sign * 1e-10 * self.s_min) * slope / (slope @ slope))
            if reached < 1.0:
                return at if self.near else None
        return None


def least(
    mechanism: Mechanism,
    start: Kinematics,
    value: Height,
    step: Array,
    admit: Callable[[Kinematics], Kinematics | None],
) -> Kinematics:
    """Walk downhill along the coordinates, with ever shorter steps; return the lowest configuration found.

    Parameters
    ----------
    mechanism : Mechanism
    start : Kinematics
    value : callable
        Of a configuration: what is to become low.
    step : (d,) array
        Longest step, rad or m.
    admit : callable
        Returns a configuration as it is, or moved to where it is allowed, or None.
    """
    at, low, scale = start, value(start), 0.5
    while scale > FINEST:
        for k in range(2 * mechanism.d):
            dq = np.zeros(mechanism.d)
            dq[k // 2] = scale * step[k // 2] * (1 if k % 2 else -1)
            there = admit(follow(mechanism, at, dq)[0])
            if there is not None and (reached := value(there)) < low - GAIN * abs(low):
                at, low = there, reached
                break
        else:
            scale /= 2
    return at
