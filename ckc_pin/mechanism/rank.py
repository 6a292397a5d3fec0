"""The rank of J: scaled to be free of units, by singular values, with the gap that makes it sure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, Immutable, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.tree import Tree

__all__ = [
    "RANK_TOLERANCE",
    "Freedoms",
    "RankReport",
    "choose_dependent",
    "compute_rank",
    "count_freedoms",
    "idle_coordinates",
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


IMMOBILE = 1e-9  # of a motion of size one: what a coordinate that cannot move takes part in it


@dataclass(frozen=True)
class Freedoms(Immutable):
    """What the rank of J says.

    Attributes
    ----------
    d : int
        Freedoms, n - rank.
    rank : RankReport
        The rank that J has around the assembled configuration.
    singular : bool
        J has a smaller rank at the assembled configuration itself.
    redundant : tuple of (loop, row)
        Rows that the others imply, one admissible choice.
    immobile : (n,) bool array
        Coordinates that the loops hold still, here and nearby.
    dependent : (rank,) int array or None
        The best-conditioned choice of z; None when it would split a free root.
    jacobian : (rows, n) array
        The scaled J that all this is about.
    warnings : tuple of str
    """

    d: int
    rank: RankReport
    singular: bool
    redundant: tuple[tuple[str, str], ...]
    immobile: BoolArray
    dependent: IntArray | None
    jacobian: Array
    warnings: tuple[str, ...]


def count_freedoms(tree: Tree, closure: Closure, q_tree: Array, nearby: Callable[[Array], list[Array]]) -> Freedoms:
    """Count the freedoms at a closed configuration, and around it.

    A change point or a collinear start has a smaller rank than every configuration nearby, so J is also looked at
    there.

    Parameters
    ----------
    q_tree : (nq,) array
        Closed.
    nearby : callable
        Given a basis of J's null space there, (k, n), closed configurations a small step along it.
    """
    jacobian = _scaled_at(tree, closure, q_tree)
    here = there = compute_rank(jacobian)
    jacobians = [(here.rank, jacobian)]
    for other in nearby(_directions(jacobian)[here.rank :]):
        candidate = _scaled_at(tree, closure, other)
        report = compute_rank(candidate)
        jacobians.append((report.rank, candidate))
        if report.rank > there.rank:
            there, jacobian = report, candidate
    immobile = np.full(tree.n, len(jacobians) > 1 or there.rank == tree.n)
    for rank, candidate in jacobians:
        if rank == there.rank:
            immobile &= np.linalg.norm(_directions(candidate)[rank:], axis=0) <= IMMOBILE
    warnings: list[str] = []
    if there.rank > here.rank:
        warnings.append(
            f"the assembled configuration is singular: rank J is {here.rank} there and {there.rank} nearby; "
            f"d = {tree.n - there.rank} is what the mechanism has nearby"
        )
    if not there.sure:
        warnings.append(
            f"the rank is not certain: relative singular values {there.above:.1e} | {there.below:.1e} around the cut "
            f"at {there.rank}; numbers rounded in the files, or nearly singular"
        )
    blocks = [np.arange(v, v + 6) for _, v in tree.free_roots]
    return Freedoms(
        d=tree.n - there.rank,
        rank=there,
        singular=there.rank > here.rank,
        immobile=immobile,
        redundant=tuple(closure.names[k] for k in redundant_rows(jacobian, there.rank)),
        dependent=choose_dependent(jacobian, there.rank, blocks),
        jacobian=jacobian,
        warnings=tuple(warnings),
    )


def idle_coordinates(tree: Tree, tangent: Array, q_tree: Array, anchors: Sequence[Anchors], turns: Array) -> list[str]:
    """Name coordinates that only spin a body about itself: no centre of mass moves, nor what loops or springs hold.

    Parameters
    ----------
    tangent : (n, d) array
        Basis of the velocities that the loops allow.
    anchors : sequence of Anchors
        Of loops and of springs.
    turns : (m, n) array
        What motors, and springs on joints, turn with each joint.
    """
    ends = [Pose(tree, x, q_tree).p_jacobian.reshape(-1, tree.n) for x in anchors if len(x.point_joint)]
    moves = np.vstack([tree.centre_of_mass_jacobians(q_tree), *ends, turns]) @ tangent
    if 0 in moves.shape:
        return []
    _, values, directions = np.linalg.svd(moves, full_matrices=True)
    still = directions[int(np.sum(values > 1e-8 * max(values[0], 1e-300))) :]
    names: list[str] = []
    for direction in still:
        motion = np.abs(tangent @ direction)
        names.append(tree.coordinates[int(np.argmax(motion))])
    return list(dict.fromkeys(names))


def _directions(jacobian: Array) -> Array:
    """Right singular vectors of J as rows, the motions that it allows last, (n, n)."""
    return np.linalg.svd(jacobian, full_matrices=True)[2]


def _scaled_at(tree: Tree, closure: Closure, q_tree: Array) -> Array:
    return scale_jacobian(closure.jacobian(Pose(tree, closure.anchors, q_tree)), tree, closure)
