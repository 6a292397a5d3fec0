"""Assembly branches: the different ways in which the loops close at the same q."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import newton
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["assembly_branches"]

STARTS = 400
LARGEST = 12  # dependent coordinates: beyond, random starts would miss most branches


def assembly_branches(mechanism: Mechanism) -> list[Kinematics]:
    """List the closed configurations at the assembled q, found from random z: the assembled one first.

    Raises
    ------
    InputError
        The mechanism is too large for random starts to tell anything.
    """
    at = mechanism.assembled
    z = mechanism.partition.z
    if len(z) > LARGEST or not mechanism.tree.is_euclidean:
        raise InputError(
            f"{mechanism.name}: branches are listed for mechanisms with at most {LARGEST} dependent joints; "
            f"this one has {len(z)}"
        )
    random = np.random.default_rng(0)
    reach = np.where(mechanism.tree.in_metres[z], mechanism.size, np.pi)
    found = [at]
    for _ in range(STARTS if len(z) else 0):
        step = np.zeros(mechanism.n)
        step[z] = random.uniform(-1.0, 1.0, len(z)) * reach
        closed = _settle(at.integrate(step), mechanism.tolerance)
        if closed is not None and all(_apart(mechanism, closed, other) for other in found):
            found.append(closed)
    return found


def _settle(start: Kinematics, tolerance: float) -> Kinematics | None:
    """Newton with steps cut to what is local."""
    at, z = start, start.partition.z
    for _ in range(60):
        outcome = newton(at, 0.0, tolerance)
        if outcome.converged:
            return outcome.at
        step = np.zeros(at.tree.n)
        step[z] = -np.linalg.lstsq(at.phi_z, at.phi, rcond=1e-6)[0]
        longest = np.abs(step).max()
        if not np.isfinite(longest) or longest == 0.0:
            return None
        at = at.integrate(step * min(1.0, 0.3 / longest))
    return None


def _apart(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> bool:
    """Whether two configurations differ by more than whole turns."""
    gap: Array = a.q_tree - b.q_tree
    angles = ~mechanism.tree.in_metres
    gap[angles] = np.remainder(gap[angles] + np.pi, 2 * np.pi) - np.pi
    return bool(np.abs(gap).max() > 1e-6)
