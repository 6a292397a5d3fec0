"""Continuation: a way is followed by pieces, each halved where it fails and twice as long where the last succeeded.

Following a way by pieces is what keeps the assembly branch: Newton's method from far away may close on another one.
Whoever follows one says how a piece is predicted and corrected; that it does not end on another branch is known by the
sign of a determinant, for between two branches there is a singular configuration.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.mechanism.configuration import Kinematics

__all__ = ["follow", "follow_many", "same_branch"]

Advance = Callable[[Kinematics, float, float], Kinematics | None]
AdvanceMany = Callable[[IntArray, Array, Array], BoolArray]


def follow_many(count: int, advance: AdvanceMany, shortest: float) -> Array:
    """Follow many ways at once.

    Parameters
    ----------
    count : int
    advance : callable
        Of which ways (k,), how much of each is done (k,), and the piece to try (k,), both as parts of the way.
        Moves those that can be moved and returns which they were, (k,) array of bool.
    shortest : float
        Where pieces shorter than this part of a way would be needed it is taken to end.

    Returns
    -------
    (count,) array
        How much of each way was followed, exactly 1 for all of it.
    """
    done, piece, active = np.zeros(count), np.ones(count), np.arange(count)
    while len(active):
        left = 1.0 - done[active]
        part = np.minimum(piece[active], left)
        good = advance(active, done[active], part)
        done[active] += np.where(good, part, 0.0)
        done[active[good & (part == left)]] = 1.0
        piece[active] = part * np.where(good, 2.0, 0.5)
        active = active[(done[active] < 1.0) & (piece[active] >= shortest)]
    return done


def follow(start: Kinematics, advance: Advance, shortest: float) -> tuple[Kinematics, float]:
    """Follow one way from a configuration on its branch.

    Parameters
    ----------
    start : Kinematics
    advance : callable
        Of a configuration, how much of the way is done and the piece to try: the next one, or None.
    shortest : float

    Returns
    -------
    at : Kinematics
        The last configuration that was reached.
    done : float
    """
    at = start

    def move(_: IntArray, done: Array, part: Array) -> BoolArray:
        nonlocal at
        there = advance(at, float(done[0]), float(part[0]))
        if there is None or not same_branch(at, there):
            return np.zeros(1, bool)
        at = there
        return np.ones(1, bool)

    done = follow_many(1, move, shortest)
    return at, float(done[0])


def same_branch(before: Kinematics, after: Kinematics) -> bool:
    """Whether det phi_z keeps its sign; True where phi_z is not square."""
    if before.phi_z.shape[0] != before.phi_z.shape[1]:
        return True
    return before.phi_z_factor.determinant() * after.phi_z_factor.determinant() > 0
