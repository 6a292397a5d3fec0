"""Explore one assembly branch over the independent coordinates by continuation of sigma.

For d = 1 and 2 a lattice is flooded from a closed configuration: neighbours are reached along rho and corrected by
Newton's method, so the branch is never left. For d > 2 a lattice would have too many points. Straight rays in random
directions are followed instead, which sample the part that is visible from the centre.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.certificate.branch_walk import Height, follow

__all__ = ["End", "Explored", "explore"]

RAYS = 300  # random directions, for d > 2
MAX_POINTS = 30_000


@dataclass(frozen=True)
class End:
    """End of a branch: the water level there, and the last node and the last configuration before it."""

    water: float
    node: int
    at: Kinematics


@dataclass
class Explored:
    """The explored part of a branch, in the order in which a rising water level would reach it.

    Attributes
    ----------
    nodes : list of Kinematics
    water : list of float
        The lowest level at which a node is connected to the centre, which is the largest height on the way to it.
    edges : list of (int, int)
        Neighbours among the nodes.
    ends : list of End
        Ends of the branch inside the explored part.
    sampled : bool
        Whether rays were followed instead of a lattice.
    truncated : bool
        Whether the exploration ended at MAX_POINTS.
    """

    nodes: list[Kinematics] = field(default_factory=list)
    water: list[float] = field(default_factory=list)
    edges: list[tuple[int, int]] = field(default_factory=list)
    ends: list[End] = field(default_factory=list)
    sampled: bool = False
    truncated: bool = False


def explore(
    mechanism: Mechanism,
    centre: Kinematics,
    step: Array,
    height: Height,
    level: float,
    turn: IntArray | None = None,
    seed: int = 0,
) -> Explored:
    """Explore the connected part of a branch around a configuration where a height is at most a level.

    Parameters
    ----------
    mechanism : Mechanism
        Without free roots.
    centre : Kinematics
        Closed.
    step : (d,) array
        Of the lattice or the rays, rad or m.
    height : callable
        Of a configuration on the branch; infinite where it must not be explored.
    level : float
    turn : (d,) int array, optional
        Steps of the lattice to a full turn of each coordinate, after which it is periodic; 0 if it is not.
    seed : int
        Of the random directions, for d > 2.

    Raises
    ------
    InputError
        A free root.
    """
    if not mechanism.tree.is_euclidean:
        raise InputError(f"{mechanism.name}: a free root's orientation is not a vector; there is no lattice of it")
    if mechanism.d <= 2:
        return _flood(mechanism, centre, step, height, level, turn)
    return _cast(mechanism, centre, step, height, level, seed)


def _flood(
    mechanism: Mechanism, centre: Kinematics, step: Array, height: Height, level: float, turn: IntArray | None
) -> Explored:
    explored = Explored()
    origin = (0,) * mechanism.d
    node_of: dict[tuple[int, ...], int] = {}
    queue: list[tuple[float, int, tuple[int, ...], Kinematics]] = []
    seen, order = {origin}, 0
    if height(centre) <= level:
        queue.append((height(centre), order, origin, centre))
    while queue:
        water, _, place, at = heapq.heappop(queue)
        node_of[place] = len(explored.nodes)
        explored.nodes.append(at)
        explored.water.append(water)
        if len(explored.nodes) >= MAX_POINTS:
            explored.truncated = True
            break
        for k in range(mechanism.d):
            for sign in (-1, 1):
                index = place[k] + sign
                index = index % turn[k] if turn is not None and turn[k] else index
                neighbour = (*place[:k], index, *place[k + 1 :])
                if neighbour in node_of:
                    explored.edges.append((node_of[neighbour], node_of[place]))
                if neighbour in seen:
                    continue
                dq = np.zeros(mechanism.d)
                dq[k] = sign * step[k]
                end, reached = follow(mechanism, at, dq)
                end_water = max(water, height(end))
                if end_water > level:
                    continue
                if reached < 1.0:
                    explored.ends.append(End(end_water, node_of[place], end))
                    continue
                seen.add(neighbour)
                order += 1
                heapq.heappush(queue, (end_water, order, neighbour, end))
    return explored


def _cast(mechanism: Mechanism, centre: Kinematics, step: Array, height: Height, level: float, seed: int) -> Explored:
    explored = Explored(sampled=True)
    if height(centre) > level:
        return explored
    random = np.random.default_rng(seed)
    explored.nodes.append(centre)
    explored.water.append(height(centre))
    for _ in range(RAYS):
        direction = random.standard_normal(mechanism.d)
        dq = step * direction / np.linalg.norm(direction)
        at, last, water = centre, 0, explored.water[0]
        while len(explored.nodes) < MAX_POINTS:
            at, reached = follow(mechanism, at, dq)
            water = max(water, height(at))
            if water > level:
                break
            if reached < 1.0:
                explored.ends.append(End(water, last, at))
                break
            explored.edges.append((last, len(explored.nodes)))
            last = len(explored.nodes)
            explored.nodes.append(at)
            explored.water.append(water)
    explored.truncated = len(explored.nodes) >= MAX_POINTS
    return explored
