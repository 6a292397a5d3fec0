"""Whether two configurations of a mechanism with one or two freedoms are in the same aspect, by the map of aspects."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.extended import Task, extend_closure
from ckc_pin.kinematics.grid import Grid, fill_grid, find_branches, make_joint_domain
from ckc_pin.kinematics.nodes import SAME_SHAPE_TOLERANCE, follow, nodes_at, shape_points
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["describe_separation"]

CELLS = 96  # along an axis
MAX_FREEDOMS = 2  # the map has all configurations of mechanisms with so many freedoms


def describe_separation(mechanism: Mechanism, start: Array, end: Array, names: tuple[str, str]) -> str:
    """Return in which aspects two closed configurations (nq,) are, in words; "" if the map does not separate them.

    The aspects have the numbers of `singularity_map`. Limits of dependent coordinates are not considered.

    Parameters
    ----------
    mechanism : Mechanism
    start, end : (nq,) arrays
    names : pair of str
        What the configurations are called.
    """
    if not 0 < mechanism.d <= MAX_FREEDOMS or not mechanism.dependent:
        return ""
    extended = extend_closure(mechanism)
    task, positions = Task(extended, extended.joints), np.arange(mechanism.d)
    domain = make_joint_domain(task, positions, mechanism.independent, CELLS)
    # A configuration in a sliver beside a singular curve may be in a cell that is not reached. So both ways are tried.
    if _contains(fill_grid(domain, start), end) or _contains(fill_grid(domain, end), start):
        return ""
    aspects = ["another aspect"] * 2
    for number, branch in reversed(list(enumerate(find_branches(task)[0], start=1))):
        grid = fill_grid(domain, branch)
        for k, q_tree in enumerate((start, end)):
            if _contains(grid, q_tree):
                aspects[k] = f"aspect {number}{' (as assembled)' if number == 1 else ''}"
    size = " x ".join([str(CELLS)] * mechanism.d)
    return f"in the map with {size} cells, {names[0]} is in {aspects[0]} and {names[1]} in {aspects[1]}"


def _contains(grid: Grid, q_tree: Array) -> bool:
    """Whether the aspect of a filled grid contains a configuration (nq,)."""
    domain = grid.domain
    values = nodes_at(domain.task, q_tree[None]).values
    number = grid.numbers(domain.nearest_cells(values[:, domain.over]))
    if not grid.reached[number[0]]:
        return False
    cell = grid.nodes(number)
    way = domain.difference(cell.values[:, domain.over], values[:, domain.over])
    node, arrived = follow(domain.task, cell, domain.to_rows(way))
    mechanism = domain.task.extended.mechanism
    gap = shape_points(mechanism, node.q_tree) - shape_points(mechanism, q_tree[None])
    return bool(arrived[0]) and bool(np.abs(gap).max() <= SAME_SHAPE_TOLERANCE * mechanism.size)
