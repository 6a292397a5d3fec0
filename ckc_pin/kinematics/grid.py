"""Grid over the axes of a map, and the aspects that one branch reaches on it by continuation.

A task gives values to some rows of the closure: independent coordinates, or coordinates of a point. One or two of these
rows are the axes of the map, the others stay fixed as assembled. Cells of the grid are reached from their neighbours. A
coarse grid is filled first, then the spacing is halved until every cell was tried. So nearly all starts of Newton's
method are close to the solution, and thousands of cells are solved together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.kinematics.extended import Task
from ckc_pin.kinematics.mapped import Axis
from ckc_pin.kinematics.nodes import MIN_PIECE, Nodes, find_solutions, follow, nodes_at

__all__ = [
    "COARSE_FRACTION",
    "CORNERS",
    "SIDES",
    "Domain",
    "Grid",
    "Progress",
    "ProgressCounter",
    "cell_centres",
    "fill_grid",
    "find_branches",
    "flood_grid",
    "make_joint_domain",
    "max_distance",
]

MAX_BRANCHES = 4
MAX_DEPENDENT = 12  # coordinates; of larger mechanisms, and of free bodies, only the assembled branch is mapped
COARSE_FRACTION = 0.5  # of the way to a neighbour; cells that need shorter pieces wait until all others are done
MIN_COARSE_CELLS = 12  # along an axis of a coarse grid
START_DISTANCE = 1.5  # coarse cells; how far the first cells may be from the first configuration
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))

T = TypeVar("T")
Progress = Callable[[float], None]  # called with the completed fraction, 0 to 1


class ProgressCounter:
    """Count pieces of work, assumed to be of equal size, and report the completed fraction."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0
        self.add(0)

    def add(self, count: int = 1) -> None:
        """Add completed pieces."""
        self.done = min(self.done + count, self.total)
        if self.progress is not None:
            self.progress(self.done / self.total)

    def add_after(self, result: T) -> T:
        """Add one completed piece and return its result."""
        self.add()
        return result


# --- axes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Domain:
    """A grid over one or two of a task's rows; the others are fixed as assembled.

    Attributes
    ----------
    task : Task
    over : (axes,) int array
        Positions of the axes in `task.rows`.
    axes : tuple of Axis
    """

    task: Task
    over: IntArray
    axes: tuple[Axis, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along both axes; 1 if there is no second axis."""
        first, *second = (len(axis.values) for axis in self.axes)
        return first, *(second or [1])  # type: ignore[return-value]

    @property
    def fixed(self) -> IntArray:
        """Positions of the fixed rows in `task.rows`."""
        return np.setdiff1d(np.arange(len(self.task.rows)), self.over)

    def values(self, cells: IntArray) -> Array:
        """Return the centres of cells (count, 2), shape (count, axes)."""
        return np.column_stack([axis.values[cells[:, k]] for k, axis in enumerate(self.axes)])

    def nearest_cells(self, places: Array) -> IntArray:
        """Return the cells (count, 2) of places (count, axes); for places outside the window, the cell next to them."""
        cells = np.zeros((len(places), 2), np.intp)
        for k, axis in enumerate(self.axes):
            count = len(axis.values)
            cell = np.floor((places[:, k] - axis.low) / (axis.high - axis.low) * count)
            cells[:, k] = np.remainder(cell, count) if axis.turns else np.clip(cell, 0, count - 1)
        return cells

    def difference(self, start: Array, end: Array) -> Array:
        """Return end - start for places (count, axes); angles are wrapped into [-pi, pi)."""
        difference = end - start
        for k, axis in enumerate(self.axes):
            if axis.turns:
                difference[:, k] = np.remainder(difference[:, k] + np.pi, 2 * np.pi) - np.pi
        return difference

    def to_rows(self, difference: Array) -> Array:
        """Return a difference along the axes (count, axes) as one of all rows of the task (count, d)."""
        rows = np.zeros((len(difference), len(self.task.rows)))
        rows[:, self.over] = difference
        return rows


def _make_joint_axis(task: Task, k: int, name: str, count: int) -> Axis:
    """Return the axis of an independent coordinate.

    Its window is a full turn, the joint's limits, or twice the mechanism's size for a slider without limits.
    """
    mechanism = task.extended.mechanism
    coordinate = mechanism.partition.q[k]
    lower, upper = (float(limit[coordinate]) for limit in mechanism.tree.limits())
    is_limited = np.isfinite(lower) and np.isfinite(upper)
    if mechanism.tree.in_metres[coordinate]:
        middle = float(mechanism.independent_part(mechanism.q_tree)[k])
        low, high = (lower, upper) if is_limited else (middle - mechanism.size, middle + mechanism.size)
        return Axis(name, "m", low, high, False, cell_centres(low, high, count))
    if is_limited and upper - lower < 2 * np.pi:
        return Axis(name, "rad", lower, upper, False, cell_centres(lower, upper, count))
    return Axis(name, "rad", -np.pi, np.pi, True, cell_centres(-np.pi, np.pi, count))


def make_joint_domain(task: Task, positions: IntArray, names: Sequence[str], cells: int) -> Domain:
    """Return a grid over independent coordinates, which are at some positions in the rows of a task."""
    axes = tuple(_make_joint_axis(task, int(k), name, cells) for k, name in zip(positions, names, strict=True))
    return Domain(task, positions, axes)


def cell_centres(low: float, high: float, count: int) -> Array:
    """Return the centres of equal cells between two ends."""
    return np.asarray(low + (np.arange(count) + 0.5) * (high - low) / count)


def find_branches(task: Task) -> tuple[Array, bool]:
    """Return a configuration of each branch to map, shape (branches, nq), and whether there are or may be more."""
    mechanism = task.extended.mechanism
    if not mechanism.tree.is_euclidean or len(mechanism.dependent) > MAX_DEPENDENT:
        return mechanism.q_tree[None], True
    solutions = find_solutions(task, nodes_at(task, mechanism.q_tree[None]).values[0], MAX_BRANCHES + 1)
    return solutions[:MAX_BRANCHES], len(solutions) > MAX_BRANCHES


def max_distance(task: Task) -> float:
    """Return an upper bound, m, of how far a point can be from its place as assembled."""
    mechanism = task.extended.mechanism
    offsets = [placement.translation for placement in mechanism.tree.model.jointPlacements]
    slides = mechanism.size * np.count_nonzero(mechanism.tree.in_metres)
    anchors = task.extended.closure.anchors.point_local
    return float(np.linalg.norm([*offsets, *anchors], axis=1).sum() + slides)


# --- cells ---------------------------------------------------------------------------------------------------------


class Grid:
    """The cells of a domain that one branch reaches, with their configurations.

    Attributes
    ----------
    domain : Domain
    reached : (cells,) array of bool
    q_tree : (cells, nq) array
        NaN where not reached, as all others.
    values : (cells, d) array
        Of the task's rows.
    J : (cells, rows, n) array
        Constraint Jacobian of the extended closure.
    det : (cells,) array
        Determinant that vanishes where the task is singular.
    """

    def __init__(self, domain: Domain) -> None:
        task, cells = domain.task, domain.shape[0] * domain.shape[1]
        n, nq = task.extended.mechanism.n, task.extended.mechanism.tree.nq
        self.domain = domain
        self.reached = np.zeros(cells, bool)
        self.q_tree = np.full((cells, nq), np.nan)
        self.values = np.zeros((cells, len(task.rows)))
        self.J = np.zeros((cells, task.extended.closure.rows, n))
        self.det = np.zeros(cells)

    def numbers(self, cells: IntArray) -> IntArray:
        """Return the numbers of cells (count, 2)."""
        return np.asarray(cells[:, 0] * self.domain.shape[1] + cells[:, 1])

    def nodes(self, numbers: IntArray) -> Nodes:
        """Return the configurations of cells that have been reached."""
        return Nodes(self.q_tree[numbers], self.values[numbers], self.J[numbers], self.det[numbers])

    def store(self, numbers: IntArray, nodes: Nodes) -> None:
        """Store the configurations of cells and mark these as reached."""
        self.reached[numbers] = True
        self.q_tree[numbers], self.values[numbers] = nodes.q_tree, nodes.values
        self.J[numbers], self.det[numbers] = nodes.J, nodes.det


def fill_grid(domain: Domain, start: Array, shortest: float = MIN_PIECE) -> Grid:
    """Reach every cell that continuation from a configuration reaches.

    Parameters
    ----------
    domain : Domain
    start : (nq,) array
    shortest : float
        Shortest piece of the way to a neighbouring cell, as a fraction.
    """
    grid = Grid(domain)
    stride = _coarse_stride(domain.shape)
    first = nodes_at(domain.task, start[None])
    cells = _cells(domain.shape, stride)
    place = first.values[:, domain.over]
    way = domain.difference(np.repeat(place, len(cells), axis=0), domain.values(cells))
    spacing = np.array([stride * (axis.high - axis.low) / len(axis.values) for axis in domain.axes])
    is_close = np.all(np.abs(way) <= START_DISTANCE * spacing, axis=1)
    cells, way = cells[is_close], way[is_close]
    nodes, arrived = follow(domain.task, first[np.zeros(len(cells), np.intp)], domain.to_rows(way))
    grid.store(grid.numbers(cells[arrived]), nodes[arrived])
    while True:
        flood_grid(grid, stride, COARSE_FRACTION)
        if stride == 1:
            flood_grid(grid, stride, shortest)
            return grid
        stride //= 2


def _coarse_stride(shape: tuple[int, int]) -> int:
    """Return the largest power of two that divides the grid and leaves enough cells."""
    stride = 1
    while all(count == 1 or (count % (2 * stride) == 0 and count >= MIN_COARSE_CELLS * 2 * stride) for count in shape):
        stride *= 2
    return stride


def _cells(shape: tuple[int, int], stride: int) -> IntArray:
    first, second = np.meshgrid(np.arange(0, shape[0], stride), np.arange(0, shape[1], stride), indexing="ij")
    return np.column_stack([first.ravel(), second.ravel()])


def flood_grid(
    grid: Grid,
    stride: int,
    shortest: float,
    numbers: IntArray | None = None,
    directions: Sequence[tuple[int, int]] = SIDES,
) -> None:
    """Try the neighbours of reached cells, then those of the newly reached cells, until no more are reached.

    Parameters
    ----------
    grid : Grid
    stride : int
        Distance of neighbours, cells.
    shortest : float
        Shortest piece of the way to a neighbour, as a fraction.
    numbers : (count,) int array, optional
        Cells to start from; default: all reached ones.
    directions : sequence of (int, int)
    """
    if numbers is None:
        cells = _cells(grid.domain.shape, stride)
        frontier = cells[grid.reached[grid.numbers(cells)]]
    else:
        frontier = np.column_stack(np.divmod(numbers, grid.domain.shape[1]))
    while len(frontier):
        reached = [_reach_neighbours(grid, frontier, np.array(step) * stride, shortest) for step in directions]
        frontier = np.concatenate(reached)


def _reach_neighbours(grid: Grid, cells: IntArray, step: IntArray, shortest: float) -> IntArray:
    """Try the neighbours of cells in one direction; return those that were reached."""
    domain, target = grid.domain, cells + step
    inside = np.ones(len(cells), bool)
    for k, axis in enumerate(domain.axes):
        if axis.turns:
            target[:, k] %= len(axis.values)
        inside &= (target[:, k] >= 0) & (target[:, k] < len(axis.values))
    if len(domain.axes) == 1:
        inside &= target[:, 1] == 0
    cells, target = cells[inside], target[inside]
    is_open = ~grid.reached[grid.numbers(target)]
    cells, target = cells[is_open], target[is_open]
    if not len(cells):
        return cells
    start = grid.nodes(grid.numbers(cells))
    way = domain.difference(start.values[:, domain.over], domain.values(target))
    nodes, arrived = follow(domain.task, start, domain.to_rows(way), shortest)
    grid.store(grid.numbers(target[arrived]), nodes[arrived])
    return target[arrived]
