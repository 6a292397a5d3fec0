"""Check that bodies and joint ranges of an imported robot can exist, and repair them on request."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import MechanismError
from ckc_pin.formats.robot import Robot

__all__ = ["check_physics"]

INERTIA_TOLERANCE = 1e-9  # relative to the largest principal moment
ZERO_INERTIA = 1e-18  # kg m^2: rounding error of a zero inertia that was rotated
REMEDY = "correct the file, or import with --repair, which"


def check_physics(robot: Robot, repair: bool) -> None:
    """Refuse masses and inertias that no body has, and ranges with lower above upper; or repair them with a note."""
    for name, link in robot.links.items():
        where, body = f"{robot.source}: link {name!r}", link.body
        if body.mass < 0:
            raise MechanismError(f"{where}: negative mass {body.mass:g} kg; correct the file")
        moments, axes = np.linalg.eigh(body.inertia)
        if moments[0] >= -(INERTIA_TOLERANCE * np.abs(moments).max() + ZERO_INERTIA):
            continue
        before = ", ".join(f"{x:.3g}" for x in moments)
        nearest = _nearest_moments(moments)
        after = ", ".join(f"{x:.3g}" for x in nearest)
        if not repair:
            raise MechanismError(
                f"{where}: its inertia has the principal moments {before} kg m^2, a negative one; no body has them; "
                f"{REMEDY} takes the nearest possible moments, {after} kg m^2"
            )
        body.inertia = axes @ np.diag(nearest) @ axes.T
        robot.guessed.append(
            f"repaired: principal moments of link {name} are {after} kg m^2 instead of {before} kg m^2"
        )
    for name, axis in robot.axes.items():
        lower, upper = axis.limits.lower, axis.limits.upper
        if lower is None or upper is None or lower <= upper:
            continue
        if not repair:
            raise MechanismError(
                f"{robot.source}: joint {name!r}: its lower limit {lower:g} is above the upper one {upper:g}; "
                f"{REMEDY} exchanges them"
            )
        axis.limits = replace(axis.limits, lower=upper, upper=lower)
        robot.guessed.append(f"repaired: the limits of joint {name} are {upper:g} and {lower:g}, exchanged")


def _nearest_moments(moments: Array) -> Array:
    """Return the nearest principal moments (least squares) of a body: each half the sum of two non-negative ones.

    With x_k = (sum of moments) / 2 - moment_k >= 0, the second moments of mass, the moments are sums of two of them.
    """
    pairs = np.ones((3, 3)) - np.eye(3)
    best, distance = np.zeros(3), np.inf
    for free in range(1, 8):  # which second moments are not zero
        columns = [k for k in range(3) if free >> k & 1]
        part = np.linalg.lstsq(pairs[:, columns], moments, rcond=None)[0]
        if part.min() >= 0:
            candidate = pairs[:, columns] @ part
            if (d := float(np.linalg.norm(candidate - moments))) < distance:
                best, distance = candidate, d
    return best
