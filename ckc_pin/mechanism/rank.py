"""The rank of J: scaled to be free of units, by singular values, with the gap that makes it sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.tree import Tree

__all__ = [
    "RANK_TOLERANCE",
    "RankReport",
    "choose_dependent",
    "compute_rank",
    "jacobian_scales",
    "redundant_rows",
    "scale_jacobian",
]

RANK_TOLERANCE = 1e-5  # relative; files are rounded to six digits
SOUND = 0.03  # of the largest pivot: what a column must bring along to be in z in the place of one that shall be in q
SURE = 1e-9  # singular values between this and the tolerance are neither zero nor not


@dataclass(frozen=True)
class RankReport:
    """The rank of J and how sure it is.

    Attributes
    ----------
    rank : int
    above, below : float
        The singular values on both sides of the cut, relative to the largest; below is 0 at full rank.
    """

    rank: int
    above: float
    below: float

    @property
    def sure(self) -> bool:
        """Whether nothing lies between rounding errors and the tolerance."""
        return self.below < SURE


def scale_jacobian(jacobian: Array, tree: Tree, closure: Closure) -> Array:
    """Make J dimensionless: lengths in units of the mechanism's size, both in rows and in columns."""
    rows, columns = jacobian_scales(tree, closure)
    return rows[:, None] * jacobian * columns


def jacobian_scales(tree: Tree, closure: Closure) -> tuple[Array, Array]:
    """Return what J's rows, shape (rows,), and its columns, shape (n,), are multiplied with for that."""
    return np.where(closure.in_metres(tree), 1.0 / tree.size, 1.0), tree.step_scale


def compute_rank(scaled_jacobian: Array) -> RankReport:
    """Count singular values above the tolerance times the largest."""
    if min(scaled_jacobian.shape) == 0:
        return RankReport(0, 0.0, 0.0)
    values = np.linalg.svd(scaled_jacobian, compute_uv=False)
    values = values / max(float(values[0]), 1e-300)
    rank = int(np.sum(values > RANK_TOLERANCE))
    below = float(values[rank]) if rank < len(values) else 0.0
    return RankReport(rank, float(values[rank - 1]) if rank else 0.0, below)


def redundant_rows(scaled_jacobian: Array, rank: int) -> IntArray:
    """Return one admissible choice of rows that the others imply, in the order of phi."""
    if scaled_jacobian.shape[0] == rank:
        return np.zeros(0, np.intp)
    order, _ = pivoted_columns(scaled_jacobian.T)
    return np.sort(order[rank:])


def choose_dependent(
    scaled_jacobian: Array, rank: int, blocks: Sequence[IntArray] = (), wanted: Sequence[int] | IntArray = ()
) -> IntArray | None:
    """Choose z so that phi_z is well conditioned, by a pivoted QR.

    Of coordinates that are as good, the last is dependent: q is where the tree begins, as motors mostly are.

    Parameters
    ----------
    scaled_jacobian : (rows, n) array
    rank : int
    blocks : sequence of index arrays
        Coordinates of free roots. Each is tried as dependent as a whole, then as independent as a whole.
    wanted : sequence of int
        Coordinates that shall be independent: dependent only where phi_z would come near to singular without them.

    Returns
    -------
    (rank,) int array, or None when a block would have to be split.
    """
    if rank == 0:
        return np.zeros(0, np.intp)
    rest = np.arange(scaled_jacobian.shape[1])[::-1]
    if len(blocks):
        inside = np.concatenate(blocks).astype(np.intp)
        rest = np.setdiff1d(rest, inside)[::-1]
        _, pivots = pivoted_columns(scaled_jacobian[:, inside])
        if len(pivots) == len(inside) and pivots[-1] > RANK_TOLERANCE * pivots[0]:
            # take the blocks as dependent and choose the rest in what they leave over
            q, _ = np.linalg.qr(scaled_jacobian[:, inside])
            left = scaled_jacobian[:, rest] - q @ (q.T @ scaled_jacobian[:, rest])
            return np.sort(np.concatenate([inside, _pivots(left, rank - len(inside), rest, wanted)]))
        if compute_rank(scaled_jacobian[:, rest]).rank < rank:
            return None
    return np.sort(_pivots(scaled_jacobian[:, rest], rank, rest, wanted))


def _pivots(matrix: Array, count: int, names: IntArray, wanted: Sequence[int] | IntArray) -> IntArray:
    """Return the names of so many columns by a pivoted QR, those that are wanted elsewhere last."""
    first = np.flatnonzero(~np.isin(names, wanted))
    if not 0 < len(first) < len(names):
        return names[pivoted_columns(matrix)[0][:count]]
    order, pivots = pivoted_columns(matrix[:, first])
    largest = np.linalg.norm(matrix, axis=0).max(initial=0.0)
    first = first[order[: min(count, int(np.sum(pivots > SOUND * largest)))]]
    q, _ = np.linalg.qr(matrix[:, first])
    others = np.setdiff1d(np.arange(len(names)), first)
    left = matrix[:, others] - q @ (q.T @ matrix[:, others])
    return names[np.concatenate([first, others[pivoted_columns(left)[0][: count - len(first)]]])]
