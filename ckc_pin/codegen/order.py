"""In which order eq. 1 is eliminated where it is written out: little fill, and no pivot that is small near by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["elimination_order", "eq_1", "least_pivot"]

STATES = 16  # near the assembled one, which is another
SPREAD = 0.5  # rad, or of the mechanism's size: how far they are from it
LEAST = 1e-2  # of what a pivot is a difference of, and of what a row's is where all rows come last
ZERO = 1e-12  # of what else there is in row and column: nothing is there


def elimination_order(mechanism: Mechanism, kept: Sequence[int]) -> tuple[int, ...]:
    """Return an order of the unknowns of [D', J^T; J, 0]: the n coordinates, and the kept rows from n on.

    Of those whose pivots are sound at all states that are looked at, the one with the fewest neighbours comes next. A
    row may so come before coordinates that it is of: then a branch is done with before another one begins. Coordinates
    that move no mass by themselves wait for all rows that they are in: each gives them a pivot only somewhere.
    """
    n = mechanism.n
    A, apart = (np.array(x) for x in zip(*_matrices(mechanism, kept), strict=True))
    size = A.shape[1]
    largest = np.abs(A).max(axis=2)
    filled = np.any(np.abs(A) > ZERO * np.minimum(largest[:, :, None], largest[:, None, :]), axis=0)
    kind = np.where(np.arange(size) < n, 1.0, -1.0)
    whole = kind * np.diagonal(A, axis1=1, axis2=2)
    massless = np.append((apart[:, :n] > 0).all(axis=0), np.zeros(size - n, dtype=bool))
    preferred = [*range(n - 1, -1, -1), *range(n, size)]  # from leaves to roots
    order: list[int] = []
    while preferred:
        pivots = kind * np.diagonal(A, axis1=1, axis2=2)
        sound = (pivots / np.maximum(np.maximum(whole, apart), 1e-300)).min(axis=0)
        sound[massless & filled[:, [k for k in preferred if k >= n]].any(axis=1)] *= LEAST / 2
        possible = [k for k in preferred if sound[k] >= min(LEAST, sound[preferred].max())]
        k = min(possible, key=lambda k: np.count_nonzero(filled[k, preferred]))
        order.append(k)
        preferred.remove(k)
        column = np.where(np.isin(np.arange(size), preferred), A[:, k], 0.0)
        own = np.where(pivots[:, k] == 0.0, np.inf, pivots[:, k])  # of what moves no mass there
        taken = kind[k] * column**2 / own[:, None]
        whole = whole + np.where(kind == kind[k], 0.0, np.abs(taken))
        A = A - kind[k] * column[:, :, None] * column[:, None, :] / own[:, None, None]
        filled |= np.outer(filled[k], filled[k])
    return tuple(order)


def least_pivot(A: Array, n: int, order: Sequence[int]) -> float:
    """Return what elimination of [D', J^T; J, 0] leaves of the pivot that most is taken from, by what that was."""
    A, kind, least = A.copy(), np.where(np.arange(len(A)) < n, 1.0, -1.0), np.inf
    whole, left = kind * np.diag(A), np.ones(len(A), dtype=bool)
    for k in order:
        pivot, left[k] = kind[k] * A[k, k], False
        least = min(least, pivot / whole[k] if whole[k] > 0 else 0.0)
        if not least > 0:
            return 0.0
        column = np.where(left, A[:, k], 0.0)
        whole = whole + np.where(kind == kind[k], 0.0, column**2 / pivot)
        A = A - kind[k] * np.outer(column, column) / pivot
    return least


def eq_1(D: Array, J: Array) -> Array:
    """Return [D', J^T; J, 0]."""
    return np.block([[D, J.T], [J, np.zeros((len(J), len(J)))]])


def _matrices(mechanism: Mechanism, kept: Sequence[int]) -> Iterator[tuple[Array, Array]]:
    """[D', J^T; J, 0] at some states, and what pivots are next to.

    Of rows: J D'^-1 J^T's, where all rows come last. Of coordinates that move no mass: what rows make of that.
    """
    tree, random, n = mechanism.tree, np.random.default_rng(0), mechanism.n
    for k in range(STATES + 1):
        step = SPREAD * random.uniform(-1, 1, n) * tree.step_scale * (k > 0)
        at = mechanism.kinematics(tree.integrate(mechanism.q_tree, step))
        D = np.triu(Terms(mechanism, at, np.zeros(n)).D_tree)
        D, J = D + np.triu(D, 1).T, at.J[list(kept)]
        rows = np.sum(J * (np.linalg.pinv(D, hermitian=True) @ J.T).T, axis=1)
        moved = np.sum(J**2 / np.where(rows > ZERO * rows.max(initial=0.0), rows, np.inf)[:, None], axis=0)
        massless = np.diag(D) <= ZERO * moved
        yield eq_1(D, J), np.concatenate([np.where(massless, moved, 0.0), rows])
