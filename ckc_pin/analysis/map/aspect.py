"""An aspect: everything that one branch reaches over a grid, by continuation from neighbour to neighbour.

A coarse grid is flooded from the branch's first configuration; then the spacing is halved until every cell has been
tried from its neighbours. So nearly all starts are close by, and thousands of cells are solved together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.analysis.map.domain import Domain
from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.kinematics.nodes import SHORTEST, Nodes, follow, nodes_at

__all__ = ["CORNERS", "HURRIED", "SIDES", "Grid", "fill", "flood"]

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
        self.q_tree[numbers], self.given[numbers] = nodes.q_tree, nodes.given
        self.J[numbers], self.det[numbers] = nodes.J, nodes.det


def fill(domain: Domain, start: Array, shortest: float = SHORTEST) -> Grid:
    """Reach what can be reached from a configuration (nq,), in pieces of the way to a cell down to the shortest."""
    grid = Grid(domain)
    stride = _stride(domain.shape)
    first = nodes_at(domain.task, start[None])
    near = _cells(domain.shape, stride)
    here = first.given[:, domain.over]
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
    way = domain.change(start.given[:, domain.over], domain.values(target))
    nodes, arrived = follow(domain.task, start, domain.change_of_all(way), shortest)
    grid.put(grid.flat(target[arrived]), nodes[arrived])
    return target[arrived]
