"""A workspace of three dimensions in sections: maps at several heights, each reached from the ones beside it.

A section alone may consist of pieces that only hang together above or below it. So a coarse stack of sections is filled
first, up and down until nothing new is reached, and what it reaches next to a section is where that begins. A piece
that is narrower than a cell of that stack, a thirtieth of the window, may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as FilePath
from time import perf_counter

import numpy as np

from ckc_pin.analysis.map.compute import located, map_value
from ckc_pin.analysis.map.grid import (
    CORNERS,
    HURRIED,
    SIDES,
    Domain,
    Grid,
    Progress,
    Steps,
    fill,
    flood,
    middles,
    reach,
)
from ckc_pin.analysis.map.loci import find_loci
from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.errors import InputError
from ckc_pin.kinematics.extended import Task, extend_closure, find_point
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.mapped import Axis, SingularityMap
from ckc_pin.kinematics.nodes import MIN_PIECE, follow, nodes_at
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Stack", "workspace_sections"]

NAMES = ("x", "y", "z")
COUNTS = (2, 24)
CELLS = (16, 400)
LOOK = 32  # cells along each direction while the window is looked for
MARGIN = 1.5  # such cells around what was found
LOOKS = 6
AROUND = (*SIDES, *CORNERS)
NEAR = 2.5  # such cells above and below a section: where it begins


def workspace_sections(
    mechanism: Mechanism | str | FilePath,
    *,
    point: str | None = None,
    over: Sequence[str] = ("x", "y"),
    count: int = 6,
    cells: int = 120,
    progress: Progress | None = None,
) -> tuple[SingularityMap, ...]:
    """Map where a point can go in three dimensions, in sections at equal distances, on the working mode as assembled.

    Parameters
    ----------
    mechanism : Mechanism, or a name or path as for `load`
    point : str, optional
        Default: the first one.
    over : two of "x", "y", "z"
        The sections' plane.
    count : int
        Of sections; those that nothing is reached of are left out.
    cells : int
        Along each axis of a section.
    progress : callable, optional
        Called as progress(part done).

    Returns
    -------
    tuple of SingularityMap
        From the lowest; all over the same window.

    Raises
    ------
    InputError
        No loops, no such point, or one whose three coordinates do not tell the configuration.
    """
    mechanism = as_mechanism(mechanism, "workspace_sections")
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: it has no loops, so it can go anywhere; map one that has")
    for name, value, (least, most) in (("sections", count, COUNTS), ("cells", cells, CELLS)):
        if not least <= value <= most:
            raise InputError(f"{name} = {value}: from {least} to {most}")
    if len(over) != 2 or len(set(over)) < 2 or not set(over) <= set(NAMES):
        raise InputError(f"over: the plane of sections is two of {', '.join(NAMES)}")
    with one_blas_thread():
        began = perf_counter()
        stack = Stack(mechanism, point, over, Steps(progress, LOOKS + 2 * count))
        grids = [grid for grid in stack.sections(count, cells) if grid.reached.any()]
        if not grids:
            raise InputError(f"{mechanism.name}: none of {count} sections is reached; ask for more")
        seconds = perf_counter() - began
        return tuple(stack.value(grid, seconds) for grid in grids)


class Stack:
    """Sections of the place of a point."""

    def __init__(
        self, mechanism: Mechanism, point: str | None, over: Sequence[str], steps: Steps | None = None
    ) -> None:
        self.extended = extend_closure(mechanism, find_point(mechanism, point))
        fixing = self.extended.fixing - self.extended.place[0]
        if mechanism.d != 3 or fixing.tolist() != [0, 1, 2]:
            raise InputError(
                f"{mechanism.name}: sections are of a mechanism of three freedoms that x, y, z of its point tell; map "
                "two coordinates instead"
            )
        self.task = Task(self.extended, self.extended.fixing)
        self.over = np.array([NAMES.index(name) for name in over], np.intp)
        self.third = int(np.setdiff1d(np.arange(3), self.over)[0])
        self.start = mechanism.q_tree
        self.middle = nodes_at(self.task, self.start[None]).values[0]
        self.steps = steps or Steps(None, 1)

    def sections(self, count: int, cells: int) -> list[Grid]:
        """Reach what can be reached of so many sections, from the lowest."""
        low, high, coarse = self.look()
        heights = middles(float(low[self.third]), float(high[self.third]), count)
        return [self.section(low, high, cells, float(height), coarse) for height in heights]

    def look(self) -> tuple[Array, Array, list[Grid]]:
        """Return the box (3,), (3,) that is reached, and what a coarse stack of sections reaches in it.

        It is looked at in ever smaller boxes that still hold it.
        """
        low, high = self.middle - reach(self.task), self.middle + reach(self.task)
        for look in range(LOOKS):
            found = self._fill_coarse(low, high)
            self.steps.step()
            places = np.concatenate([self.middle[None], *(grid.given[grid.reached] for grid in found)])
            room = MARGIN * (high - low) / LOOK
            tight_low = np.maximum(places.min(axis=0) - room, low)
            tight_high = np.minimum(places.max(axis=0) + room, high)
            shrinks = np.any(tight_high - tight_low < 0.8 * (high - low))
            low, high = tight_low, tight_high
            if not shrinks:
                self.steps.step(LOOKS - 1 - look)
                break
        return low, high, found

    def _fill_coarse(self, low: Array, high: Array) -> list[Grid]:
        """Reach what can be reached in a box, beginning at the nearest section that is straight above or below."""
        heights = middles(float(low[self.third]), float(high[self.third]), LOOK)
        self.spacing = float(heights[1] - heights[0])
        layers = [self._grid(low, high, LOOK) for _ in heights]
        start = nodes_at(self.task, self.start[None])
        for first in np.argsort(np.abs(heights - self.middle[self.third])):
            begun, arrived = follow(self.task, start, self._up(heights[first] - self.middle[self.third], 1))
            if arrived[0]:
                layers[first] = fill(layers[first].domain, begun.q_tree[0], HURRIED)
                break
        tried, more = np.zeros((LOOK, 2, LOOK**2), bool), True
        while more:  # up, then down
            more = False
            for side, upward in enumerate((1, -1)):
                for k in range(LOOK - 1)[::upward]:
                    source, target = (k, k + 1) if upward > 0 else (k + 1, k)
                    way = heights[target] - heights[source]
                    more |= self._pass_on(layers[source], layers[target], way, tried[source, side])
        return layers

    def _pass_on(self, source: Grid, target: Grid, way: float, tried: BoolArray) -> bool:
        """Reach cells of a section straight from the one beside it, then from there; say whether there were any."""
        open_ = np.flatnonzero(source.reached & ~target.reached & ~tried)
        if not len(open_):
            return False
        tried[open_] = True
        nodes, arrived = follow(self.task, source.nodes(open_), self._up(way, len(open_)), HURRIED)
        target.put(open_[arrived], nodes[arrived])
        flood(target, 1, HURRIED, open_[arrived], AROUND)
        return bool(np.any(arrived))

    def section(self, low: Array, high: Array, cells: int, height: float, coarse: Sequence[Grid]) -> Grid:
        """Reach what can be reached of a section, beginning from all that is reached right above and below it."""
        grid = self._grid(low, high, cells)
        for layer in coarse:
            near = np.flatnonzero(layer.reached & (np.abs(layer.given[:, self.third] - height) <= NEAR * self.spacing))
            target = grid.domain.nearest(layer.given[near][:, self.over])
            way = self._up(height - layer.given[near, self.third], len(near))
            way[:, self.over] = grid.domain.values(target) - layer.given[near][:, self.over]
            nodes, arrived = follow(self.task, layer.nodes(near), way, HURRIED)
            grid.put(grid.flat(target[arrived]), nodes[arrived])
        flood(grid, 1, MIN_PIECE, ways=AROUND)  # pieces may be narrower than a cell
        self.steps.step()
        return grid

    def _grid(self, low: Array, high: Array, cells: int) -> Grid:
        axes = tuple(
            Axis(NAMES[k], "m", float(low[k]), float(high[k]), False, middles(float(low[k]), float(high[k]), cells))
            for k in self.over
        )
        return Grid(Domain(self.task, self.over, axes))

    def _up(self, way: float | Array, count: int) -> Array:
        change = np.zeros((count, 3))
        change[:, self.third] = way
        return change

    def value(self, grid: Grid, seconds: float) -> SingularityMap:
        """Trace a section's loci and return it as a map."""
        loci = [located(self.extended, locus) for locus in find_loci(self.extended, grid.domain, [grid], True)]
        self.steps.step()
        return map_value(self.extended, "cartesian", [grid], loci, more_branches=True, seconds=seconds)
