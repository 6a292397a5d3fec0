"""Continuation: follow a path of configurations in pieces, so that the assembly branch does not change.

A piece that fails is halved, and after a piece that succeeds the next one is twice as long. Newton's method from a
distant start could converge on another branch. The caller predicts and corrects each piece. A change of branch is
recognised by the sign of a determinant, since a singular configuration separates two branches.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.tree import Tree

__all__ = ["MAX_NEWTON_STEP", "MAX_SEARCH_STEP", "follow", "follow_many", "is_local", "same_branch"]

MAX_NEWTON_STEP = 0.5  # rad, or mechanism sizes, of any coordinate: a longer step may lead to another solution
MAX_SEARCH_STEP = 0.3  # rad or m, of any coordinate: longest step of a search from a random start

Advance = Callable[[Kinematics, float, float], Kinematics | None]
AdvanceMany = Callable[[IntArray, Array, Array], BoolArray]


def is_local(tree: Tree, step: Array) -> BoolArray:
    """Whether Newton steps, shape (..., n), are short enough to stay near the solution; False for NaN."""
    return np.asarray(tree.step_size(step) <= MAX_NEWTON_STEP)


def follow_many(count: int, advance: AdvanceMany, min_piece: float) -> Array:
    """Follow many paths at once.

    Parameters
    ----------
    count : int
        Number of paths.
    advance : callable
        Gets the numbers of some paths (k,), the fraction of each that is done (k,), and the fraction to try next (k,).
        Moves the paths that can be moved and returns which they were, (k,) array of bool.
    min_piece : float
        A path ends where a piece shorter than this fraction would be needed.

    Returns
    -------
    (count,) array
        Fraction of each path that was followed, exactly 1 for a complete path.
    """
    done, piece, active = np.zeros(count), np.ones(count), np.arange(count)
    while len(active):
        remaining = 1.0 - done[active]
        part = np.minimum(piece[active], remaining)
        succeeded = advance(active, done[active], part)
        done[active] += np.where(succeeded, part, 0.0)
        done[active[succeeded & (part == remaining)]] = 1.0
        piece[active] = part * np.where(succeeded, 2.0, 0.5)
        active = active[(done[active] < 1.0) & (piece[active] >= min_piece)]
    return done


def follow(start: Kinematics, advance: Advance, min_piece: float) -> tuple[Kinematics, float]:
    """Follow one path from a configuration, on its branch.

    Parameters
    ----------
    start : Kinematics
    advance : callable
        Gets a configuration, the fraction of the path that is done, and the fraction to try next. Returns the next
        configuration, or None.
    min_piece : float
        The path ends where a piece shorter than this fraction would be needed.

    Returns
    -------
    at : Kinematics
        The last configuration that was reached.
    done : float
        Fraction of the path that was followed.
    """
    at = start

    def advance_one(_: IntArray, done: Array, part: Array) -> BoolArray:
        nonlocal at
        trial = advance(at, float(done[0]), float(part[0]))
        if trial is None or not same_branch(at, trial):
            return np.zeros(1, bool)
        at = trial
        return np.ones(1, bool)

    done = follow_many(1, advance_one, min_piece)
    return at, float(done[0])


def same_branch(before: Kinematics, after: Kinematics) -> bool:
    """Whether det phi_z has the same sign in two configurations; with redundant rows, whether det(phi_z^+ phi_z') > 0.

    Both are equal if phi_z is square. With redundant rows the determinant is that of phi_z in the column space of its
    first value, so it is reliable if that space does not turn much: between nearby configurations, and in planar loops.
    """
    rows, columns = before.phi_z.shape
    if rows == columns:
        return before.phi_z_factor.determinant() * after.phi_z_factor.determinant() > 0
    if before.phi_z_factor.singular:
        return False
    relative = before.phi_z_factor.solve(after.phi_z)
    return bool(np.linalg.slogdet(relative)[0] > 0)
