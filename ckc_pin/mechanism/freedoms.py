"""How many freedoms a closed mechanism has, and of what kind: redundant rows, singular starts, idle spins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.values import Immutable
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.rank import RankReport, choose_dependent, compute_rank, redundant_rows, scale_jacobian
from ckc_pin.mechanism.tree import Tree

__all__ = ["Freedoms", "count_freedoms", "idle_coordinates"]

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
