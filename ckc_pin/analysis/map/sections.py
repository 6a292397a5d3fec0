"""Sections of a three-dimensional workspace: maps at several heights, each reached from the sections next to it.

A section may consist of pieces that are connected only above or below it. A coarse stack of sections is therefore
filled first, up and down until nothing new is reached. A section then starts from what the stack reaches next to it. A
piece that is narrower than a cell of the stack, a thirtieth of the window, may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as FilePath
from time import perf_counter

import numpy as np

from ckc_pin.analysis.map.compute import add_positions, make_map
from ckc_pin.analysis.map.loci import find_loci
from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.errors import InputError
from ckc_pin.kinematics.extended import Task, extend_closure, find_point
from ckc_pin.kinematics.grid import (
    COARSE_FRACTION,
    CORNERS,
    SIDES,
    Domain,
    Grid,
    Progress,
    ProgressCounter,
    cell_centres,
    fill_grid,
    flood_grid,
    max_distance,
)
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.mapped import Axis, SingularityMap
from ckc_pin.kinematics.nodes import MIN_PIECE, follow, nodes_at
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["SectionStack", "workspace_sections"]

AXIS_NAMES = ("x", "y", "z")
MIN_SECTIONS, MAX_SECTIONS = 2, 24
MIN_CELLS, MAX_CELLS = 16, 400  # along an axis of a section
COARSE_CELLS = 32  # along each direction of the coarse stack
BOX_MARGIN = 1.5  # coarse cells around what is reached
BOX_SEARCHES = 6
BOX_SHRINKAGE = 0.8  # the search ends if the next box is not smaller by this factor
START_DISTANCE = 2.5  # coarse sections; above and below a section, configurations so near are its starts
ALL_DIRECTIONS = (*SIDES, *CORNERS)


def workspace_sections(
    mechanism: Mechanism | str | FilePath,
    *,
    point: str | None = None,
    over: Sequence[str] = ("x", "y"),
    count: int = 6,
    cells: int = 120,
    progress: Progress | None = None,
) -> tuple[SingularityMap, ...]:
    """Map the three-dimensional workspace of a point in equidistant sections, on the assembled working mode.

    Parameters
    ----------
    mechanism : Mechanism, or a name or path as for `load`
    point : str, optional
        Default: the first one.
    over : two of "x", "y", "z"
        The plane of the sections.
    count : int
        Number of sections. Those of which nothing is reached are left out.
    cells : int
        Along each axis of a section.
    progress : callable, optional
        Called as progress(fraction), from 0 to 1.

    Returns
    -------
    tuple of SingularityMap
        From the lowest, all over the same window.

    Raises
    ------
    InputError
        No loops, an unknown point, or a point whose three coordinates do not determine the configuration.
    """
    mechanism = as_mechanism(mechanism, "workspace_sections")
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: without loops the mechanism is never singular; map one with loops")
    for name, value, smallest, largest in (
        ("sections", count, MIN_SECTIONS, MAX_SECTIONS),
        ("cells", cells, MIN_CELLS, MAX_CELLS),
    ):
        if not smallest <= value <= largest:
            raise InputError(f"{name} = {value}: expected {smallest} to {largest}")
    if len(over) != 2 or len(set(over)) < 2 or not set(over) <= set(AXIS_NAMES):
        raise InputError(f"over: expected two of {', '.join(AXIS_NAMES)} as the plane of the sections")
    with one_blas_thread():
        start = perf_counter()
        stack = SectionStack(mechanism, point, over, ProgressCounter(progress, BOX_SEARCHES + 2 * count))
        grids = [grid for grid in stack.fill_sections(count, cells) if grid.reached.any()]
        if not grids:
            raise InputError(f"{mechanism.name}: none of {count} sections is reached; ask for more sections")
        seconds = perf_counter() - start
        return tuple(stack.make_section(grid, seconds) for grid in grids)


class SectionStack:
    """Sections of the workspace of a point.

    Raises
    ------
    InputError
        The mechanism does not have three freedoms, or the point's position does not determine the configuration.
    """

    def __init__(
        self, mechanism: Mechanism, point: str | None, over: Sequence[str], progress: ProgressCounter | None = None
    ) -> None:
        self.extended = extend_closure(mechanism, find_point(mechanism, point))
        fixing = self.extended.fixing - self.extended.place[0]
        if mechanism.d != 3 or fixing.tolist() != [0, 1, 2]:
            raise InputError(
                f"{mechanism.name}: sections need three freedoms that x, y and z of the point determine; map two "
                "coordinates instead"
            )
        self.task = Task(self.extended, self.extended.fixing)
        self.over = np.array([AXIS_NAMES.index(name) for name in over], np.intp)
        self.normal = int(np.setdiff1d(np.arange(3), self.over)[0])
        self.start = mechanism.q_tree
        self.middle = nodes_at(self.task, self.start[None]).values[0]
        self.progress = progress or ProgressCounter(None, 1)

    def fill_sections(self, count: int, cells: int) -> list[Grid]:
        """Reach what can be reached of equidistant sections, from the lowest."""
        low, high, coarse = self.find_box()
        heights = cell_centres(float(low[self.normal]), float(high[self.normal]), count)
        return [self._fill_section(low, high, cells, float(height), coarse) for height in heights]

    def find_box(self) -> tuple[Array, Array, list[Grid]]:
        """Return the box (3,), (3,) that is reached, and the coarse stack of sections in it.

        The box is found by filling ever smaller boxes coarsely.
        """
        low, high = self.middle - max_distance(self.task), self.middle + max_distance(self.task)
        for search in range(BOX_SEARCHES):
            layers = self._fill_coarse(low, high)
            self.progress.add()
            places = np.concatenate([self.middle[None], *(grid.values[grid.reached] for grid in layers)])
            margin = BOX_MARGIN * (high - low) / COARSE_CELLS
            new_low = np.maximum(places.min(axis=0) - margin, low)
            new_high = np.minimum(places.max(axis=0) + margin, high)
            has_shrunk = np.any(new_high - new_low < BOX_SHRINKAGE * (high - low))
            low, high = new_low, new_high
            if not has_shrunk:
                self.progress.add(BOX_SEARCHES - 1 - search)
                break
        return low, high, layers

    def _fill_coarse(self, low: Array, high: Array) -> list[Grid]:
        """Reach what can be reached in a box, from the nearest section straight above or below the start."""
        heights = cell_centres(float(low[self.normal]), float(high[self.normal]), COARSE_CELLS)
        self.spacing = float(heights[1] - heights[0])
        layers = [self._make_grid(low, high, COARSE_CELLS) for _ in heights]
        start = nodes_at(self.task, self.start[None])
        for first in np.argsort(np.abs(heights - self.middle[self.normal])):
            nodes, arrived = follow(self.task, start, self._normal_step(heights[first] - self.middle[self.normal], 1))
            if arrived[0]:
                layers[first] = fill_grid(layers[first].domain, nodes.q_tree[0], COARSE_FRACTION)
                break
        tried, has_new = np.zeros((COARSE_CELLS, 2, COARSE_CELLS**2), bool), True
        while has_new:
            has_new = False
            for side, order in enumerate((1, -1)):  # up, then down
                for k in range(COARSE_CELLS - 1)[::order]:
                    source, target = (k, k + 1) if order > 0 else (k + 1, k)
                    step = heights[target] - heights[source]
                    has_new |= self._reach_next_layer(layers[source], layers[target], step, tried[source, side])
        return layers

    def _reach_next_layer(self, source: Grid, target: Grid, step: float, tried: BoolArray) -> bool:
        """Reach cells of a section straight from the section next to it, then their neighbours; return if any were."""
        cells = np.flatnonzero(source.reached & ~target.reached & ~tried)
        if not len(cells):
            return False
        tried[cells] = True
        nodes, arrived = follow(self.task, source.nodes(cells), self._normal_step(step, len(cells)), COARSE_FRACTION)
        target.store(cells[arrived], nodes[arrived])
        flood_grid(target, 1, COARSE_FRACTION, cells[arrived], ALL_DIRECTIONS)
        return bool(np.any(arrived))

    def _fill_section(self, low: Array, high: Array, cells: int, height: float, coarse: Sequence[Grid]) -> Grid:
        """Reach what can be reached of a section, starting from everything in the coarse stack just above and below."""
        grid = self._make_grid(low, high, cells)
        for layer in coarse:
            distance = np.abs(layer.values[:, self.normal] - height)
            starts = np.flatnonzero(layer.reached & (distance <= START_DISTANCE * self.spacing))
            target = grid.domain.nearest_cells(layer.values[starts][:, self.over])
            way = self._normal_step(height - layer.values[starts, self.normal], len(starts))
            way[:, self.over] = grid.domain.values(target) - layer.values[starts][:, self.over]
            nodes, arrived = follow(self.task, layer.nodes(starts), way, COARSE_FRACTION)
            grid.store(grid.numbers(target[arrived]), nodes[arrived])
        # Diagonal neighbours are tried, too, because pieces may be narrower than a cell.
        flood_grid(grid, 1, MIN_PIECE, directions=ALL_DIRECTIONS)
        self.progress.add()
        return grid

    def _make_grid(self, low: Array, high: Array, cells: int) -> Grid:
        ends = [(AXIS_NAMES[k], float(low[k]), float(high[k])) for k in self.over]
        axes = tuple(Axis(name, "m", a, b, False, cell_centres(a, b, cells)) for name, a, b in ends)
        return Grid(Domain(self.task, self.over, axes))

    def _normal_step(self, step: float | Array, count: int) -> Array:
        """Return a step (count, 3) of the point across the sections."""
        steps = np.zeros((count, 3))
        steps[:, self.normal] = step
        return steps

    def make_section(self, grid: Grid, seconds: float) -> SingularityMap:
        """Trace the loci of a filled section, and return it as a map."""
        loci = find_loci(self.extended, grid.domain, [grid], is_cartesian=True)
        self.progress.add()
        loci = [add_positions(self.extended, locus) for locus in loci]
        return make_map(self.extended, "cartesian", [grid], loci, more_branches=True, seconds=seconds)
