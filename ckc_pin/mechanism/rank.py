"""Freedoms: the rank of J by singular values, redundant rows, and which coordinates can serve as q."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.mechanism.tree import Array, IntArray

__all__ = ["RankReport", "choose_dependent", "rank_of", "redundant_rows"]


@dataclass(frozen=True)
class RankReport:
    """The rank of J and how sure it is.

    Attributes
    ----------
    rank : int
    singular_values : (min(rows, n),) array
        Of the scaled J, descending.
    gap : (above, below)
        The singular values on both sides of the cut; below is 0 when there is none.
    """

    rank: int
    singular_values: Array
    gap: tuple[float, float]


def rank_of(jacobian: Array, tolerance: float) -> RankReport:
    """Rank of a scaled J: singular values above tolerance times the largest."""
    if min(jacobian.shape) == 0:
        return RankReport(0, np.zeros(0), (0.0, 0.0))
    values: Array = np.linalg.svd(jacobian, compute_uv=False).astype(float)
    rank = int(np.sum(values > tolerance * max(values[0], 1e-300)))
    below = float(values[rank]) if rank < len(values) else 0.0
    return RankReport(rank, values, (float(values[rank - 1]) if rank else 0.0, below))


def redundant_rows(jacobian: Array, rank: int) -> IntArray:
    """Return one admissible choice of rows that the others imply, in the order of phi."""
    if jacobian.shape[0] == rank:
        return np.zeros(0, np.intp)
    from scipy.linalg import qr

    _, _, pivots = qr(jacobian.T, mode="economic", pivoting=True)
    return np.sort(pivots[rank:]).astype(np.intp)


def choose_dependent(jacobian: Array, rank: int) -> IntArray:
    """Choose z: the coordinates whose columns make phi_z best conditioned, by a pivoted QR."""
    if rank == 0:
        return np.zeros(0, np.intp)
    from scipy.linalg import qr

    _, _, pivots = qr(jacobian, mode="economic", pivoting=True)
    return np.sort(pivots[:rank]).astype(np.intp)
