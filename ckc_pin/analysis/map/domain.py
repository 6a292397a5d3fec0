"""What a map is drawn over: two given rows of a `Task`, their windows, and a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.kinematics.extended import Task
from ckc_pin.kinematics.mapped import Axis

__all__ = ["Domain", "joint_axis", "reach"]


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
