"""What a map is drawn over: two given rows of a `Task`, their windows, and a grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.kinematics.extended import Task
from ckc_pin.kinematics.mapped import Axis
from ckc_pin.kinematics.nodes import MIN_PIECE, Nodes, follow, nodes_at

__all__ = ["CORNERS", "HURRIED", "SIDES", "Domain", "Grid", "Progress", "Steps", "fill", "flood", "joint_axis", "reach"]


@dataclass(frozen=True)
class Domain:
    """A grid over some of a task's given rows, the others fixed as assembled.

    Attributes
    ----------
    task : Task
    over : (axes,) int array
        Places among `task.rows`.
    axes : tuple of Axis
    """

    task: Task
    over: IntArray
    axes: tuple[Axis, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along both axes; one along a second axis that there is none of."""
        first, *second = (len(axis.values) for axis in self.axes)
        return first, *(second or [1])  # type: ignore[return-value]

    @property
    def fixed(self) -> IntArray:
        """Places among `task.rows` of the rows that are fixed."""
        return np.setdiff1d(np.arange(len(self.task.rows)), self.over)

    def values(self, cells: IntArray) -> Array:
        """Middles of cells (count, 2), shape (count, axes)."""
        return np.column_stack([axis.values[cells[:, k]] for k, axis in enumerate(self.axes)])

    def nearest(self, at: Array) -> IntArray:
        """Cells (count, 2) that places (count, axes) lie in or, outside the window, next to."""
        cells = np.zeros((len(at), 2), np.intp)
        for k, axis in enumerate(self.axes):
            count = len(axis.values)
            cell = np.floor((at[:, k] - axis.low) / (axis.high - axis.low) * count)
            cells[:, k] = np.remainder(cell, count) if axis.turns else np.clip(cell, 0, count - 1)
        return cells

    def change(self, start: Array, end: Array) -> Array:
        """Shortest way between places (count, axes), through the seam of an angle where that is shorter."""
        gap = end - start
        for k, axis in enumerate(self.axes):
            if axis.turns:
                gap[:, k] = np.remainder(gap[:, k] + np.pi, 2 * np.pi) - np.pi
        return gap

    def change_of_all(self, change: Array) -> Array:
        """Changes of all given rows (count, d) for changes along the axes (count, axes)."""
        full = np.zeros((len(change), len(self.task.rows)))
        full[:, self.over] = change
        return full


def joint_axis(task: Task, k: int, name: str, count: int) -> Axis:
    """Return the axis of an independent coordinate: a full turn, its limits, or twice the mechanism's size."""
    mechanism = task.extended.mechanism
    at = mechanism.partition.q[k]
    lower, upper = (float(limit[at]) for limit in mechanism.tree.limits())
    limited = np.isfinite(lower) and np.isfinite(upper)
    if mechanism.tree.in_metres[at]:
        middle = float(mechanism.independent_part(mechanism.q_tree)[k])
        low, high = (lower, upper) if limited else (middle - mechanism.size, middle + mechanism.size)
        return Axis(name, "m", low, high, False, middles(low, high, count))
    if limited and upper - lower < 2 * np.pi:
        return Axis(name, "rad", lower, upper, False, middles(lower, upper, count))
    return Axis(name, "rad", -np.pi, np.pi, True, middles(-np.pi, np.pi, count))


def middles(low: float, high: float, count: int) -> Array:
    """Middles of cells of one size."""
    return np.asarray(low + (np.arange(count) + 0.5) * (high - low) / count)


def reach(task: Task) -> float:
    """No point is farther than this from where it is assembled, m."""
    mechanism = task.extended.mechanism
    offsets = [placement.translation for placement in mechanism.tree.model.jointPlacements]
    slides = mechanism.size * np.count_nonzero(mechanism.tree.in_metres)
    anchors = task.extended.closure.anchors.point_local
    return float(np.linalg.norm([*offsets, *anchors], axis=1).sum() + slides)


# --- An aspect: everything that one branch reaches over a grid, by continuation from neighbour to neighbour.
# XXX
# A coarse grid is flooded from the branch's first configuration; then the spacing is halved until every cell has been
# tried from its neighbours. So nearly all starts are close by, and thousands of cells are solved together.
#

HURRIED = 0.5  # of a way: cells that take shorter pieces wait until all easy ones are done
COARSE = 12  # cells along an axis that a coarse grid has at least
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


class Grid:
    """The cells of a domain that have been reached, and their configurations."""

    def __init__(self, domain: Domain) -> None:
        task, cells = domain.task, domain.shape[0] * domain.shape[1]
        n, nq = task.extended.mechanism.n, task.extended.mechanism.tree.nq
        self.domain = domain
        self.reached = np.zeros(cells, bool)
        self.q_tree = np.full((cells, nq), np.nan)
        self.given = np.zeros((cells, len(task.rows)))
        self.J = np.zeros((cells, task.extended.closure.rows, n))
        self.det = np.zeros(cells)

    def flat(self, cells: IntArray) -> IntArray:
        """Numbers of cells (count, 2)."""
        return np.asarray(cells[:, 0] * self.domain.shape[1] + cells[:, 1])

    def nodes(self, numbers: IntArray) -> Nodes:
        """What has been computed there."""
        return Nodes(self.q_tree[numbers], self.given[numbers], self.J[numbers], self.det[numbers])

    def put(self, numbers: IntArray, nodes: Nodes) -> None:
        """Mark cells as reached."""
        self.reached[numbers] = True
        self.q_tree[numbers], self.given[numbers] = nodes.q_tree, nodes.values
        self.J[numbers], self.det[numbers] = nodes.J, nodes.det


def fill(domain: Domain, start: Array, shortest: float = MIN_PIECE) -> Grid:
    """Reach what can be reached from a configuration (nq,), in pieces of the way to a cell down to the shortest."""
    grid = Grid(domain)
    stride = _stride(domain.shape)
    first = nodes_at(domain.task, start[None])
    near = _cells(domain.shape, stride)
    here = first.values[:, domain.over]
    way = domain.change(np.repeat(here, len(near), axis=0), domain.values(near))
    spacing = np.array([stride * (axis.high - axis.low) / len(axis.values) for axis in domain.axes])
    close = np.all(np.abs(way) <= 1.5 * spacing, axis=1)
    near, way = near[close], way[close]
    nodes, arrived = follow(domain.task, first[np.zeros(len(near), np.intp)], domain.change_of_all(way))
    grid.put(grid.flat(near[arrived]), nodes[arrived])
    while True:
        flood(grid, stride, HURRIED)
        if stride == 1:
            flood(grid, stride, shortest)
            return grid
        stride //= 2


def _stride(shape: tuple[int, int]) -> int:
    """Largest power of two that leaves a grid coarse but not too coarse."""
    stride = 1
    while all(count == 1 or (count % (2 * stride) == 0 and count >= COARSE * 2 * stride) for count in shape):
        stride *= 2
    return stride


def _cells(shape: tuple[int, int], stride: int) -> IntArray:
    first, second = np.meshgrid(np.arange(0, shape[0], stride), np.arange(0, shape[1], stride), indexing="ij")
    return np.column_stack([first.ravel(), second.ravel()])


def flood(
    grid: Grid, stride: int, shortest: float, numbers: IntArray | None = None, ways: Sequence[tuple[int, int]] = SIDES
) -> None:
    """Try the neighbours, `stride` cells away, of reached cells, then of the newly reached ones, and so on.

    Of all of them, or of those with the numbers given.
    """
    if numbers is None:
        cells = _cells(grid.domain.shape, stride)
        frontier = cells[grid.reached[grid.flat(cells)]]
    else:
        frontier = np.column_stack(np.divmod(numbers, grid.domain.shape[1]))
    while len(frontier):
        new = [_spread(grid, frontier, np.array(direction) * stride, shortest) for direction in ways]
        frontier = np.concatenate(new)


def _spread(grid: Grid, cells: IntArray, direction: IntArray, shortest: float) -> IntArray:
    """Try the neighbours of cells in one direction; return those that were reached."""
    domain, target = grid.domain, cells + direction
    inside = np.ones(len(cells), bool)
    for k, axis in enumerate(domain.axes):
        if axis.turns:
            target[:, k] %= len(axis.values)
        inside &= (target[:, k] >= 0) & (target[:, k] < len(axis.values))
    if len(domain.axes) == 1:
        inside &= target[:, 1] == 0
    cells, target = cells[inside], target[inside]
    open_ = ~grid.reached[grid.flat(target)]
    cells, target = cells[open_], target[open_]
    if not len(cells):
        return cells
    start = grid.nodes(grid.flat(cells))
    way = domain.change(start.values[:, domain.over], domain.values(target))
    nodes, arrived = follow(domain.task, start, domain.change_of_all(way), shortest)
    grid.put(grid.flat(target[arrived]), nodes[arrived])
    return target[arrived]


# --- How far a map has come, for those who wait for it.

T = TypeVar("T")
Progress = Callable[[float], None]  # called with the part done, 0 to 1


class Steps:
    """Counts pieces of work, taken to be of one size."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0
        self.step(0)

    def after(self, result: T) -> T:
        """Say that the piece that gave this result is done."""
        self.step()
        return result

    def step(self, count: int = 1) -> None:
        """Say that some more are done."""
        self.done = min(self.done + count, self.total)
        if self.progress is not None:
            self.progress(self.done / self.total)
