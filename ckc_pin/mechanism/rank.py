"""Rank of the constraint Jacobian J, degrees of freedom, redundant rows, and the choice of dependent coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array, BoolArray, Immutable, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns, remove_direction
from ckc_pin.base.sparse import factorize_full_row_rank
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.tree import Tree

__all__ = [
    "RANK_TOLERANCE",
    "Freedoms",
    "RankReport",
    "choose_dependent",
    "choose_dependent_by_priority",
    "compute_rank",
    "count_freedoms",
    "idle_coordinates",
    "jacobian_scales",
    "redundant_rows",
    "scale_jacobian",
]

RANK_TOLERANCE = 1e-5  # of the largest singular value; numbers in files are rounded to six digits
# Part of a column of J that is orthogonal to the columns chosen before, relative to the column: a coordinate becomes
# dependent in its turn above the first, and instead of a driven one above the second.
GOOD_PIVOT, MIN_PIVOT = 0.2, 0.03
ROUNDING_LEVEL = 1e-9  # singular values between this and RANK_TOLERANCE make the rank uncertain


class RankReport(Struct, frozen=True):
    """The rank of J and how certain it is.

    Attributes
    ----------
    rank : int
    above, below : float
        Smallest singular value that counts and largest that does not, relative to the largest; `below` is 0 at full
        rank.
    """

    rank: int
    above: float
    below: float

    @property
    def is_certain(self) -> bool:
        """Whether no singular value lies between rounding errors and the tolerance."""
        return self.below < ROUNDING_LEVEL


def scale_jacobian(jacobian: Array, tree: Tree, closure: Closure) -> Array:
    """Make J dimensionless: lengths in units of the mechanism's size, in rows and in columns."""
    rows, columns = jacobian_scales(tree, closure)
    return rows[:, None] * jacobian * columns


def jacobian_scales(tree: Tree, closure: Closure) -> tuple[Array, Array]:
    """Return the factors of the rows, shape (rows,), and columns, shape (n,), that make J dimensionless."""
    return np.where(closure.in_metres(tree), 1.0 / tree.size, 1.0), tree.step_scale


def compute_rank(scaled_jacobian: Array) -> RankReport:
    """Return the number of singular values above `RANK_TOLERANCE` times the largest."""
    if min(scaled_jacobian.shape) == 0:
        return RankReport(0, 0.0, 0.0)
    full = factorize_full_row_rank(scaled_jacobian)
    if full:
        return RankReport(len(scaled_jacobian), full.smallest / full.largest, 0.0)
    values = np.linalg.svd(scaled_jacobian, compute_uv=False)
    values = values / max(float(values[0]), 1e-300)
    rank = int(np.sum(values > RANK_TOLERANCE))
    below = float(values[rank]) if rank < len(values) else 0.0
    return RankReport(rank, float(values[rank - 1]) if rank else 0.0, below)


def redundant_rows(scaled_jacobian: Array, rank: int) -> IntArray:
    """Return one admissible choice of rows that the other rows imply, in the order of phi."""
    if scaled_jacobian.shape[0] == rank:
        return np.zeros(0, np.intp)
    order, _ = pivoted_columns(scaled_jacobian.T)
    return np.sort(order[rank:])


def choose_dependent(scaled_jacobian: Array, rank: int, blocks: Sequence[IntArray] = ()) -> IntArray | None:
    """Choose the dependent coordinates z so that phi_z is well conditioned, by a pivoted QR.

    Of equally good coordinates the last becomes dependent, since motors are mostly at the beginning of the tree.

    Parameters
    ----------
    scaled_jacobian : (rows, n) array
    rank : int
    blocks : sequence of index arrays
        Coordinates of free roots, which are all dependent or all independent. Dependent is tried first.

    Returns
    -------
    (rank,) int array, or None if a block would have to be split.
    """
    inside, rest = _split_blocks(scaled_jacobian, rank, blocks)
    if inside is None:
        return None
    remainder = scaled_jacobian[:, rest]
    if len(inside):  # Choose the others by their parts orthogonal to the blocks.
        q, _ = np.linalg.qr(scaled_jacobian[:, inside])
        remainder = remainder - q @ (q.T @ remainder)
    pivots = pivoted_columns(remainder)[0][: rank - len(inside)]
    return np.sort(np.concatenate([inside, rest[pivots]]).astype(np.intp))


def choose_dependent_by_priority(
    scaled_jacobian: Array, rank: int, order: Sequence[int], driven: Sequence[int], blocks: Sequence[IntArray] = ()
) -> IntArray | None:
    """Choose the dependent coordinates z from the end of a fixed order, driven coordinates last.

    A coordinate becomes dependent if its column of J has a large part orthogonal to the columns chosen before. The
    choice therefore does not change with small changes of the configuration, unlike that of a pivoted QR.

    Parameters
    ----------
    scaled_jacobian : (rows, n) array
    rank : int
    order : sequence of int
        All coordinates; those that should be independent first.
    driven : sequence of int
        Coordinates that become dependent only if phi_z would be nearly singular without them, the last first.
    blocks : sequence of index arrays
        Coordinates of free roots, which are all dependent or all independent. Dependent is tried first.

    Returns
    -------
    (rank,) int array, or None if a block would have to be split.
    """
    inside, rest = _split_blocks(scaled_jacobian, rank, blocks)
    if inside is None:
        return None
    z: list[int] = []
    remainder, sizes = scaled_jacobian.copy(), np.linalg.norm(scaled_jacobian, axis=0)
    columns, remaining = np.arange(len(sizes)), sizes.copy()

    def make_dependent(k: int) -> None:
        remove_direction(remainder, remainder[:, k] / remaining[k], columns, remaining)
        remainder[:, k] = remaining[k] = 0.0
        z.append(k)

    for k in inside[pivoted_columns(scaled_jacobian[:, inside])[0]] if len(inside) else ():
        make_dependent(int(k))
    candidates = [k for k in reversed(order) if k in set(rest.tolist())]
    others = [k for k in candidates if k not in driven]
    last = [k for k in reversed(driven) if k in candidates]
    for group, threshold in ((others, GOOD_PIVOT), (others, MIN_PIVOT), (last, GOOD_PIVOT)):
        for k in group:
            limit = max(threshold * sizes[k], RANK_TOLERANCE * sizes.max(initial=0.0))
            if len(z) < rank and remaining[k] > limit:
                make_dependent(k)
    while len(z) < rank:
        make_dependent(int(np.argmax(remaining)))
    return np.sort(np.array(z, dtype=np.intp))


def _split_blocks(scaled_jacobian: Array, rank: int, blocks: Sequence[IntArray]) -> tuple[IntArray | None, IntArray]:
    """Return the dependent coordinates of blocks, None if a block would be split, and the others, the last first."""
    rest = np.arange(scaled_jacobian.shape[1])[::-1]
    if not len(blocks) or not rank:
        return np.zeros(0, np.intp), rest
    inside = np.concatenate(blocks).astype(np.intp)
    rest = np.setdiff1d(rest, inside)[::-1]
    _, pivots = pivoted_columns(scaled_jacobian[:, inside])
    if len(pivots) == len(inside) and pivots[-1] > RANK_TOLERANCE * pivots[0]:
        return inside, rest
    return None if compute_rank(scaled_jacobian[:, rest]).rank < rank else np.zeros(0, np.intp), rest


IDLE_TOLERANCE = 1e-6  # of the largest motion; a centre of mass rounded to six digits counts as on its axis
IMMOBILE_TOLERANCE = 1e-9  # largest part of a coordinate that cannot move in motions of size one


class Freedoms(Immutable, frozen=True):
    """Degrees of freedom of a mechanism, from the rank of J.

    Attributes
    ----------
    d : int
        Degrees of freedom, n - rank.
    rank : RankReport
        Rank of J near the assembled configuration.
    singular : bool
        J has a smaller rank at the assembled configuration than near it.
    redundant : tuple of (loop, row)
        Rows that the other rows imply, one admissible choice.
    immobile : (n,) bool array
        Coordinates that the loops do not let move, here and nearby.
    splits_roots : bool
        Every choice of z splits the six coordinates of a free root.
    jacobian : (rows, n) array
        The dimensionless J that the rank was computed from.
    warnings : tuple of str
    """

    d: int
    rank: RankReport
    singular: bool
    redundant: tuple[tuple[str, str], ...]
    immobile: BoolArray
    splits_roots: bool
    jacobian: Array
    warnings: tuple[str, ...]


def count_freedoms(tree: Tree, closure: Closure, q_tree: Array, nearby: Callable[[Array], list[Array]]) -> Freedoms:
    """Count the degrees of freedom at a closed configuration and near it.

    At a change point, or at a collinear start, the rank of J is smaller than at every configuration nearby. J is
    therefore also evaluated there.

    Parameters
    ----------
    q_tree : (nq,) array
        A closed configuration.
    nearby : callable
        Returns closed configurations a small step along the null space of J, of which it gets a basis (k, n).
    """
    jacobian = _scaled_at(tree, closure, q_tree)
    here = there = compute_rank(jacobian)
    jacobians = [(here.rank, jacobian)]
    for other in nearby(_null_space_rows(jacobian, here.rank)):
        candidate = _scaled_at(tree, closure, other)
        report = compute_rank(candidate)
        jacobians.append((report.rank, candidate))
        if report.rank > there.rank:
            there, jacobian = report, candidate
    immobile = np.full(tree.n, len(jacobians) > 1 or there.rank == tree.n)
    for rank, candidate in jacobians:
        if rank == there.rank:
            immobile &= np.linalg.norm(_null_space_rows(candidate, rank), axis=0) <= IMMOBILE_TOLERANCE
    warnings: list[str] = []
    if there.rank > here.rank:
        warnings.append(
            f"the assembled configuration is singular: rank J is {here.rank} there and {there.rank} nearby; "
            f"d = {tree.n - there.rank} is the number of freedoms nearby"
        )
    if not there.is_certain:
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
        splits_roots=bool(blocks) and choose_dependent(jacobian, there.rank, blocks) is None,
        jacobian=jacobian,
        warnings=tuple(warnings),
    )


def idle_coordinates(tree: Tree, tangent: Array, q_tree: Array, anchors: Sequence[Anchors], shafts: Array) -> list[str]:
    """Name coordinates that only spin a body about itself, one for each such freedom.

    Such a motion moves no centre of mass, no point of a loop or spring, and no shaft.

    Parameters
    ----------
    tree : Tree
    tangent : (n, d) array
        Basis of the velocities that the loops allow.
    q_tree : (nq,) array
    anchors : sequence of Anchors
        Points of loops and springs.
    shafts : (m, n) array
        Rates of motor shafts, and of springs on joints, by joint rates.
    """
    ends = [Pose(tree, x, q_tree).p_motions(tangent) for x in anchors if len(x.point_joint)]
    moves = np.vstack([tree.centre_of_mass_motions(q_tree, tangent), *ends, shafts @ tangent])
    if 0 in moves.shape:
        return []
    _, values, directions = np.linalg.svd(np.linalg.qr(moves, mode="r"), full_matrices=True)
    idle_motions = directions[int(np.sum(values > IDLE_TOLERANCE * max(values[0], 1e-300))) :] @ tangent.T
    # Singular vectors of equal values mix the spins of several bodies; the pivots of a QR belong to one body each.
    order, _ = pivoted_columns(idle_motions)
    return [tree.coordinates[k] for k in sorted(int(k) for k in order[: len(idle_motions)])]


def _null_space_rows(jacobian: Array, rank: int) -> Array:
    """Return an orthonormal basis of the null space of J as rows, shape (n - rank, n)."""
    full = factorize_full_row_rank(jacobian)
    return full.null_space().T if full else np.linalg.svd(jacobian, full_matrices=True)[2][rank:]


def _scaled_at(tree: Tree, closure: Closure, q_tree: Array) -> Array:
    return scale_jacobian(closure.jacobian(Pose(tree, closure.anchors, q_tree)), tree, closure)
