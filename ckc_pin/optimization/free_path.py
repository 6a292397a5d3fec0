"""Paths of the independent coordinates between two configurations, within limits and without singular configurations.

The straight line in q is tried first, then two trees of configurations that grow towards each other (RRT-Connect,
Kuffner and LaValle 2000). The branches of the trees are straight lines in q, followed by continuation on the constraint
manifold. The path through both trees is shortened, and its corners are rounded.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.aspects import describe_separation
from ckc_pin.kinematics.extended import Task, extend_closure
from ckc_pin.kinematics.nodes import Nodes, follow, nodes_at
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.path import CoordinatePath, round_corners

__all__ = ["MAX_ATTEMPTS", "FreeSpace", "find_path", "is_separated", "search_path"]

MAX_ATTEMPTS = 2000  # random configurations that the trees grow towards
CLEARANCE = 0.3  # of the smaller sigma_min of the ends: least one of a path that is preferred
CLEAR_ATTEMPTS = 400  # at such a path
BATCH = 16  # of them, towards which a tree grows at once
MAX_BRANCH = 1.0  # rad, or sizes of the mechanism: length of a tree's branch towards a random configuration
MIN_BRANCH = 1e-2  # the same: shorter branches are not added
SMALL_PIECE = 2e-3  # the same: limits are not checked between the ends of shorter pieces
# Smallest pieces of lines: between given configurations, and between random ones, which need not come close to limits
MIN_PIECE, TREE_PIECE = 2.0**-11, 2.0**-6
MAX_RELATIVE_CHANGE = 0.6  # of phi_z along a piece: largest eigenvalue of phi_z^-1 times the change
PATH_FACTOR = 1.5  # length of a quantity's way along a piece, relative to its change
NEAR_ENDS = 0.5  # rad, or sizes of the mechanism: half of the random q are in the box of the ends, enlarged so much
BEYOND_ENDS = np.pi  # the same for the other half, where coordinates have no limits
MEETING_TOLERANCE = 1e-6  # rad, m: of the configurations in which lines meet
LIMIT_TOLERANCE = 1e-9  # of limits at the ends of pieces
SHORTCUT_ROUNDS = 20
SHORTCUTS = 8  # tried in a round
MIN_SAVING = 1e-3  # of the length: a round that saves less fails
MAX_FAILED_ROUNDS = 6
ROUNDING = 0.45  # of the shorter line at a corner, at first; halved until the path is within the limits
MAX_HALVINGS = 10
CHECKED_PLACES = 12  # between two breaks of a rounded path


class FreeSpace:
    """The configurations of a mechanism within limits of coordinates, singularity and points.

    Parameters
    ----------
    mechanism : Mechanism
        Without a free root among its independent coordinates.
    limits : MotionLimits
    start : (nq,) array
        The closed configuration whose smallest singular value of phi_z the limit of singularity is relative to.
    min_sigma : float
        Another lower limit of the smallest singular value.
    """

    def __init__(self, mechanism: Mechanism, limits: MotionLimits, start: Array, min_sigma: float = 0.0) -> None:
        self.mechanism, self.limits = mechanism, limits
        extended = extend_closure(mechanism)
        self.task = Task(extended, extended.joints)
        self.scale = mechanism.tree.step_scale[mechanism.partition.q]
        self._limited = np.flatnonzero(np.isfinite(limits.q).any(axis=0))
        turns = mechanism.tree.is_angle & ~np.isfinite(limits.q).any(axis=0)
        self._turning = mechanism.tree.q_index[mechanism.partition.z[turns[mechanism.partition.z]]]
        self._min_sigma = min_sigma
        if limits.singularity:
            self._min_sigma = max(min_sigma, limits.singularity * float(self.sigma_min(self.node(start))[0]))

    def node(self, q_tree: Array) -> Nodes:
        """Return a closed configuration (nq,) as a node."""
        return nodes_at(self.task, q_tree[None])

    def follow(self, start: Nodes, step: Array, min_piece: float = MIN_PIECE) -> tuple[Nodes, BoolArray]:
        """Follow lines in q from nodes as far as they stay within the limits and do not reach a singular configuration.

        Returns the last nodes, and whether they are the lines' ends.
        """
        return follow(self.task, start, step, min_piece, self._accept)

    def repeat(self, start: Nodes, step: Array) -> Nodes:
        """Return the ends of lines in q that were followed before, so that limits need no check."""
        return follow(self.task, start, step, MIN_PIECE, self._stays_regular)[0]

    def distances(self, nodes: Nodes) -> Array:
        """Return distances from the limits, negative outside: of sigma_min, coordinates and points, (m, limits)."""
        q = self._coordinates(nodes)
        lower, upper = self.limits.q[:, self._limited]
        columns = [np.minimum(q - lower, upper - q)]
        for p, (_, centre, radius) in zip(self._points(nodes), self.limits.spheres, strict=True):
            columns.append(np.linalg.norm(p - centre, axis=1)[:, None] - radius)
        if self._min_sigma:
            columns.append(self.sigma_min(nodes)[:, None] - self._min_sigma)
        return np.hstack(columns)

    def is_same(self, one: Nodes, other: Nodes) -> BoolArray:
        """Whether nodes with the same q are the same configurations, up to whole turns of dependent joints."""
        gap = one.q_tree - other.q_tree
        gap[:, self._turning] -= 2 * np.pi * np.round(gap[:, self._turning] / (2 * np.pi))
        return np.asarray(np.abs(gap).max(axis=1) <= MEETING_TOLERANCE)

    def length(self, step: Array) -> Array:
        """Return the lengths of steps of q (..., d), in rad or sizes of the mechanism."""
        return np.linalg.norm(step / self.scale, axis=-1)

    def _accept(self, start: Nodes, end: Nodes) -> BoolArray:
        """Whether no limit and no singular configuration lies between the ends of pieces.

        A quantity does not reach a limit if its way is shorter than its distances from the limit at both ends together.
        By Weyl's inequality, the smallest singular value of phi_z changes by no more than phi_z does.
        """
        begin, finish = self.distances(start), self.distances(end)
        accepted = (finish >= -LIMIT_TOLERANCE).all(axis=1)
        ways = [np.abs(self._coordinates(end) - self._coordinates(start))]
        for a, b in zip(self._points(start), self._points(end), strict=True):
            ways.append(np.linalg.norm(b - a, axis=1)[:, None])
        if self._min_sigma:
            ways.append(np.linalg.norm(self._phi_z(end) - self._phi_z(start), 2, axis=(1, 2))[:, None])
        between = (begin + finish >= PATH_FACTOR * np.hstack(ways)).all(axis=1)
        accepted &= between | (self.length(end.values - start.values) <= SMALL_PIECE)
        if accepted.any():
            accepted[accepted] = self._stays_regular(start[accepted], end[accepted])
        return np.asarray(accepted)

    def _stays_regular(self, start: Nodes, end: Nodes) -> BoolArray:
        """Whether the matrices between phi_z at both ends of pieces are regular.

        These are phi_z + t change for t from 0 to 1, if all eigenvalues of phi_z^-1 change are smaller than 1.
        """
        phi_z = self._phi_z(start)
        regular = np.ones(len(phi_z), dtype=bool)
        if phi_z.shape[2]:
            relative = np.linalg.solve(phi_z, self._phi_z(end) - phi_z)
            suspect = np.linalg.norm(relative, axis=(1, 2)) > MAX_RELATIVE_CHANGE
            regular[suspect] = np.abs(np.linalg.eigvals(relative[suspect])).max(axis=1) <= MAX_RELATIVE_CHANGE
        return regular

    def _phi_z(self, nodes: Nodes) -> Array:
        return nodes.J[:, self.task.extended.free][:, :, self.mechanism.partition.z]

    def sigma_min(self, nodes: Nodes) -> Array:
        """Return the smallest singular values of phi_z, infinite without loops."""
        phi_z = self._phi_z(nodes)
        if not phi_z.shape[2]:
            return np.full(len(phi_z), np.inf)
        return np.asarray(np.linalg.svd(phi_z, compute_uv=False)[:, -1])

    def _coordinates(self, nodes: Nodes) -> Array:
        """Return the coordinates that have limits."""
        tree = self.mechanism.tree
        if tree.is_euclidean or not len(self._limited):
            return nodes.q_tree[:, self._limited]
        return np.array([tree.to_coordinates(x)[self._limited] for x in nodes.q_tree])

    def _points(self, nodes: Nodes) -> Array:
        """Return the positions of the points that stay out of spheres, (spheres, m, 3)."""
        names = [name for name, _, _ in self.limits.spheres]
        if not names:
            return np.zeros((0, len(nodes.q_tree), 3))
        places = [self.mechanism.point_positions(x) for x in nodes.q_tree]
        return np.array([[place[name] for place in places] for name in names])


def search_path(mechanism: Mechanism, limits: MotionLimits, start: Array, end: Array) -> CoordinatePath:
    """Return a path between two closed configurations (nq,), three times differentiable.

    A path at some distance from singular configurations is preferred.

    Parameters
    ----------
    mechanism : Mechanism
    limits : MotionLimits
        Those of coordinates, singularity and points hold along the path.
    start, end : (nq,) arrays
        Within the limits.

    Raises
    ------
    InputError
        Singular configurations separate the ends.
    NumericalError
        No path was found.
    """
    is_connected = not is_separated(mechanism, limits, start, end)
    path = find_path(mechanism, limits, start, end) if is_connected else None
    if path is not None:
        return path
    if aspects := describe_separation(mechanism, start, end, ("`from`", "`to`")):
        raise InputError(f"optimize: not connected: {aspects}; see `ckc map {mechanism.name}`")
    if mechanism.d == 1:
        raise NumericalError(
            f"optimize: stuck: {mechanism.independent[0]} cannot go straight from `from` to `to` within the limits; if "
            "it turns, a target that differs by 2 pi may be on the other side"
        )
    raise NumericalError(
        f"optimize: stuck: no path from `from` to `to` was found in {MAX_ATTEMPTS} attempts; a limit or a singular "
        "configuration may separate them. Plan in several parts or with wider limits, and see `ckc map`"
    )


def is_separated(mechanism: Mechanism, limits: MotionLimits, start: Array, end: Array) -> bool:
    """Whether det phi_z has different signs at two closed configurations (nq,)."""
    space = FreeSpace(mechanism, limits, start)
    return bool(np.sign(space.node(start).det[0]) * np.sign(space.node(end).det[0]) < 0)


def find_path(
    mechanism: Mechanism, limits: MotionLimits, start: Array, end: Array, max_attempts: int = MAX_ATTEMPTS
) -> CoordinatePath | None:
    """Return a path as `search_path`, or None after so many attempts."""
    space = FreeSpace(mechanism, limits, start)
    ends = space.node(start), space.node(end)
    if space.is_same(*ends)[0]:
        return CoordinatePath(PiecewisePolynomial(np.array([0.0, 1.0]), ends[0].values[None], end=1.0), start=start)
    usual = min(float(space.sigma_min(node)[0]) for node in ends)
    clear = FreeSpace(mechanism, limits, start, CLEARANCE * usual if mechanism.dependent else 0.0)
    for within, attempts in ((clear, CLEAR_ATTEMPTS), (space, max_attempts)):
        corners = _connect(within, *ends, min(attempts, max_attempts) if mechanism.d > 1 else 0)
        q = None if corners is None else _round(within, _shorten(within, corners))
        if q is not None:
            return CoordinatePath(q, start=start)
    return None


# --- trees ---------------------------------------------------------------------------------------


class _Tree:
    """Configurations that lines in q connect with a root."""

    def __init__(self, space: FreeSpace, root: Nodes) -> None:
        self.space, self.nodes, self.parents = space, root, np.array([-1])

    def grow(self, q: Array, longest: float) -> tuple[IntArray, BoolArray]:
        """Grow from the nearest configurations towards places q (m, d); branches are at most `longest` long.

        Returns the numbers of the branches' ends, -1 for short branches, and whether they are at the places.
        """
        nearest = self.space.length(q[:, None] - self.nodes.values[None]).argmin(axis=1)
        start = self.nodes[nearest]
        step = q - start.values
        part = np.minimum(1.0, longest / np.maximum(self.space.length(step), 1e-300))
        end, arrived = self.space.follow(start, part[:, None] * step, TREE_PIECE)
        is_long = arrived | (self.space.length(end.values - start.values) >= MIN_BRANCH)
        numbers = np.full(len(q), -1)
        numbers[is_long] = len(self.parents) + np.arange(np.count_nonzero(is_long))
        self.nodes, self.parents = self.nodes.joined(end[is_long]), np.append(self.parents, nearest[is_long])
        return numbers, arrived & (part == 1.0)

    def way_to_root(self, number: int) -> list[int]:
        """Return the numbers of configurations from one to the root."""
        way = [number]
        while self.parents[way[-1]] >= 0:
            way.append(int(self.parents[way[-1]]))
        return way


def _connect(space: FreeSpace, start: Nodes, end: Nodes, attempts: int) -> Nodes | None:
    """Return the corners of a path of lines in q from one configuration to another; None if no path was found.

    Parameters
    ----------
    space : FreeSpace
    start, end : Nodes
        One configuration each, within the limits.
    attempts : int
        Random configurations to grow towards. The random numbers are the same in each call.
    """
    reached, arrived = space.follow(start, end.values - start.values)
    if arrived[0] and space.is_same(reached, end)[0]:
        return start.joined(end)
    random, box = np.random.default_rng(0), _boxes(space, start, end)
    trees = [_Tree(space, start), _Tree(space, end)]
    for round_ in range(attempts // BATCH):
        active, other = trees[round_ % 2], trees[1 - round_ % 2]
        lower, upper = box[(round_ // 2) % 2]
        numbers, _ = active.grow(lower + (upper - lower) * random.random((BATCH, len(lower))), MAX_BRANCH)
        numbers = numbers[numbers >= 0]
        if not len(numbers):
            continue
        targets = active.nodes[numbers]
        ends, arrived = other.grow(targets.values, np.inf)
        for k in np.flatnonzero(arrived):
            if space.is_same(other.nodes[ends[k : k + 1]], targets[k : k + 1])[0]:
                here, there = active.way_to_root(int(numbers[k])), other.way_to_root(int(ends[k]))
                path = active.nodes[np.array(here[::-1])].joined(other.nodes[np.array(there[1:], dtype=np.intp)])
                return path if round_ % 2 == 0 else path[np.arange(len(path.values))[::-1]]
    return None


def _boxes(space: FreeSpace, start: Nodes, end: Nodes) -> list[tuple[Array, Array]]:
    """Return the boxes of random q, near the ends and as far as the limits allow."""
    ends = np.array([start.values[0], end.values[0]])
    limit = space.limits.q[:, space.mechanism.partition.q]
    boxes = []
    for beyond in (NEAR_ENDS, BEYOND_ENDS):
        low, high = ends.min(axis=0) - beyond * space.scale, ends.max(axis=0) + beyond * space.scale
        boxes.append((np.maximum(low, limit[0]), np.minimum(high, limit[1])))
    return boxes


# --- shorter and smoother ------------------------------------------------------------------------


def _shorten(space: FreeSpace, path: Nodes) -> Nodes:
    """Return a shorter path of lines in q between the same ends, by random shortcuts."""
    random, failed = np.random.default_rng(0), 0
    for _ in range(SHORTCUT_ROUNDS):
        if len(path.values) == 2 or failed == MAX_FAILED_ROUNDS:
            break
        s = np.concatenate([[0.0], np.cumsum(space.length(np.diff(path.values, axis=0)))])
        cuts = np.sort(random.uniform(0.0, s[-1], (SHORTCUTS, 2)), axis=1)
        pieces = np.clip(np.searchsorted(s, cuts, side="right") - 1, 0, len(s) - 2)
        cuts, pieces = cuts[pieces[:, 0] < pieces[:, 1]], pieces[pieces[:, 0] < pieces[:, 1]]
        failed += 1
        if not len(cuts):
            continue
        ends = [_find_places_along(space, path, s, cuts[:, k], pieces[:, k]) for k in (0, 1)]
        step = ends[1].values - ends[0].values
        saved = cuts[:, 1] - cuts[:, 0] - space.length(step)
        reached, arrived = space.follow(ends[0], step, TREE_PIECE)
        saved = np.where(arrived & space.is_same(reached, ends[1]), saved, 0.0)
        best = int(np.argmax(saved))
        if saved[best] > MIN_SAVING * s[-1]:
            first, last = np.arange(pieces[best, 0] + 1), np.arange(pieces[best, 1] + 1, len(s))
            path = path[first].joined(ends[0][best : best + 1]).joined(ends[1][best : best + 1]).joined(path[last])
            path, failed = path[np.append(space.length(np.diff(path.values, axis=0)) > 0, True)], 0
    return path


def _find_places_along(space: FreeSpace, path: Nodes, s: Array, at: Array, piece: IntArray) -> Nodes:
    """Return the configurations at lengths along a path."""
    start = path[piece]
    part = (at - s[piece]) / (s[piece + 1] - s[piece])
    return space.repeat(start, part[:, None] * (path.values[piece + 1] - start.values))


def _round(space: FreeSpace, path: Nodes) -> PiecewisePolynomial | None:
    """Return a path over s from 0 to 1, three times differentiable, with the corners of a path of lines rounded.

    Each rounding is as large as the limits allow, up to a factor of two. None if the path leaves the limits however
    small they are.
    """
    lengths = np.linalg.norm(np.diff(path.values, axis=0), axis=1)
    reach = np.concatenate([[0.0], ROUNDING * np.minimum(lengths[1:], lengths[:-1]), [0.0]])
    for _ in range(1 + MAX_HALVINGS * (len(reach) - 2)):
        q = round_corners(path.values, reach)
        blocked = _first_blocked(space, path[:1], q)
        if blocked is None:
            return q
        if len(reach) > 2:  # the corner nearest to the place where the rounded path leaves the limits
            reach[1 + int(np.argmin(space.length(path.values[1:-1] - blocked)))] /= 2
    return None


def _first_blocked(space: FreeSpace, start: Nodes, q: PiecewisePolynomial) -> Array | None:
    """Return the place (d,) from which a path cannot be followed within the limits; None if it can be."""
    parts = np.arange(CHECKED_PLACES) / CHECKED_PLACES
    s = np.append((q.breaks[:-1, None] + np.diff(q.breaks)[:, None] * parts).ravel(), 1.0)
    for place in q(s)[0][1:]:
        start, arrived = space.follow(start, (place - start.values[0])[None])
        if not arrived[0]:
            return start.values[0]
    return None
