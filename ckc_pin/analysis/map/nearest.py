"""Find the singular configuration that is nearest to a desired trajectory, measured in all independent coordinates.

The distance is the smallest |q_s - q_d(t)| over the instants of the trajectory and over the configurations q_s at which
phi_z is singular on the trajectory's assembly branch. It is the radius of the largest ball that can be moved along the
trajectory without touching the end of the branch. Straight lines in q from the trajectory therefore reach the nearest
singular configuration on the branch, and each line that ends gives an upper bound.

- Search: lines in many directions are followed from many instants until the first of them end. Where q is locked, the
  singular configurations are so few that lines pass them by. There |det| has a small minimum along a line.
- Refinement: Gauss-Newton steps with damping minimize the distance on the solutions of `SingularSystem`.
- Check: the straight line from the trajectory leads to the solution on the branch, and no searched line is shorter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.singularities import RESIDUAL_TOLERANCE, SingularSystem, classify_solution
from ckc_pin.base.arrays import Array
from ckc_pin.control.desired import Desired
from ckc_pin.kinematics.extended import Task, extend_closure
from ckc_pin.kinematics.mapped import NearestSingular
from ckc_pin.kinematics.nodes import Nodes, follow, nodes_at
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import joined

__all__ = ["find_nearest_singular"]

INSTANTS = 32  # of the trajectory from which lines are followed
DIRECTIONS = 24  # random ones, in addition to the axes
SHELL = 0.1  # rad, or mechanism sizes if all q are lengths: length of a line that is followed at once
MAX_SHELLS = 31  # half a turn
PIECE = 2.0**-7  # of a shell: resolution of the lengths of lines that end
SEARCH_RATIO = 1.5  # lines are followed to this multiple of the shortest one that ended
MAX_STARTS = 6  # of the refinement: ends of lines, and as many minima of |det|
START_SPACING = 0.25  # of the shortest line; starts are further apart than this in q
DIP_RATIO = 0.5  # a minimum of |det| along a line counts below this multiple of its value at the trajectory
MAX_ITERATIONS = 200  # of the refinement
STATIONARITY = 1e-9  # cosine between the gap and the directions in which it can be reduced
NULL_SPACE_TOLERANCE = 1e-9  # of the largest singular value of the equations' Jacobian
TIE_TOLERANCE = 1e-9  # relative; of equal distances the first one is returned, on every machine
MIN_DAMPING, MAX_DAMPING = 1e-12, 1e8
CHECK_PIECES = 64  # of the line to a solution
CHECK_END = 1e-4  # of that line; at its very end phi_z is singular
CHECK_TOLERANCE = 0.1  # of the distance: how near the line's end leads to the solution; a fold gives sqrt(CHECK_END)


def find_nearest_singular(mechanism: Mechanism, desired: Desired, t: Array) -> NearestSingular | None:
    """Return the singular configuration nearest to a desired trajectory in all of q, on its assembly branch.

    Parameters
    ----------
    mechanism : Mechanism
    desired : Desired
        A trajectory that stays on the branch.
    t : (m,) array
        Ends, and instants between them, s. One instant for a set point.

    Returns
    -------
    NearestSingular or None
        None if no singular configuration was found within half a turn (or pi mechanism sizes), if the search and the
        refinement disagree, or if a free root has independent coordinates.
    """
    if mechanism.independent_root_coordinates:
        return None
    search = _Search(mechanism, desired, t)
    best: NearestSingular | None = None
    for start in search.find_starts():
        nearest = search.refine(start)
        if nearest is not None and (best is None or nearest.distance < best.distance * (1 - TIE_TOLERANCE)):
            best = nearest
    return None if best is None or best.distance > search.upper_bound else best


@dataclass(frozen=True)
class _Start:
    """A start of the refinement: a time, and a configuration that is nearly singular."""

    t: float
    q_tree: Array


class _Search:
    """Search of one trajectory."""

    def __init__(self, mechanism: Mechanism, desired: Desired, t: Array) -> None:
        self.mechanism, self.desired = mechanism, desired
        self.system = SingularSystem(mechanism)
        extended = extend_closure(mechanism)
        self.task = Task(extended, extended.joints)
        self.q = mechanism.partition.q
        self.t = t[np.unique(np.linspace(0, len(t) - 1, INSTANTS + 1).astype(int))]
        self.shell = SHELL * (mechanism.size if mechanism.tree.in_metres[self.q].all() else 1.0)
        self.upper_bound = np.inf
        at: Kinematics | None = None
        self.path: list[Kinematics] = []
        for time in self.t:
            at = sigma(mechanism, desired(float(time))[0], at).at
            self.path.append(at)

    def find_starts(self) -> list[_Start]:
        """Follow lines in q until the shortest ones have ended; return their ends and the minima of |det| on them."""
        directions = _unit_directions(self.mechanism.d)
        nodes = nodes_at(self.task, np.repeat([at.q_tree for at in self.path], len(directions), axis=0))
        times, way = np.repeat(self.t, len(directions)), np.tile(self.shell * directions, (len(self.t), 1))
        origin, active, lengths = nodes.values.copy(), np.arange(len(way)), np.full(len(way), np.inf)
        dips, depths = nodes[np.arange(len(way))], np.ones(len(way))  # of |det|, relative to its value at the origin
        first, was_falling = np.abs(nodes.det), np.zeros(len(way), bool)
        for k in range(MAX_SHELLS):
            if k * self.shell > SEARCH_RATIO * lengths.min() or not len(active):
                break
            before = nodes[active]
            moved, arrived = follow(self.task, before, way[active], PIECE)
            falls = np.abs(moved.det) < np.abs(before.det)
            depth = np.abs(before.det) / first[active]
            is_dip = was_falling[active] & ~falls & arrived & (depth < depths[active])
            dips.put(active[is_dip], before[is_dip])
            depths[active[is_dip]] = depth[is_dip]
            nodes.put(active, moved)
            was_falling[active] = falls
            stopped = active[~arrived]
            lengths[stopped] = np.linalg.norm(nodes.values[stopped] - origin[stopped], axis=1)
            active = active[arrived]
        self.upper_bound = float(lengths.min()) + 2 * PIECE * self.shell
        depths[depths >= DIP_RATIO] = np.inf
        return self._choose_starts(nodes, lengths, times) + self._choose_starts(dips, depths, times)

    def _choose_starts(self, nodes: Nodes, order: Array, times: Array) -> list[_Start]:
        """Choose nodes that are apart in q, in a finite order."""
        chosen: list[int] = []
        spacing = START_SPACING * min(self.upper_bound, 1.0)
        for k in np.argsort(order, kind="stable"):
            if len(chosen) == MAX_STARTS or not np.isfinite(order[k]):
                break
            if all(np.linalg.norm(nodes.values[k] - nodes.values[other]) > spacing for other in chosen):
                chosen.append(int(k))
        return [_Start(float(times[k]), nodes.q_tree[k]) for k in chosen]

    def refine(self, start: _Start) -> NearestSingular | None:
        """Minimize the distance from a start; None if that fails, or leads to another branch."""
        mechanism, system, t = self.mechanism, self.system, start.t
        at = mechanism.kinematics(start.q_tree)
        at, v, residual = system.solve(at, system.null_vector(at))
        if residual > max(RESIDUAL_TOLERANCE, mechanism.tolerance):
            return None
        damping, gap = 1e-3, self._gap(at, t)
        for _ in range(MAX_ITERATIONS):
            basis = self._null_space(at, v)
            slope = np.column_stack([basis[self.q], -self.desired(t)[1]])
            gradient = slope.T @ gap
            if (t <= self.t[0] and gradient[-1] > 0) or (t >= self.t[-1] and gradient[-1] < 0):
                slope[:, -1] = gradient[-1] = 0.0  # the trajectory ends there
            scale = np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
            if np.abs(gradient / scale).max() <= STATIONARITY * np.linalg.norm(gap) or damping > MAX_DAMPING:
                break
            normal = slope.T @ slope + damping * np.eye(slope.shape[1])
            step = -np.linalg.solve(normal, gradient)
            move = basis @ step[:-1]
            trial, trial_v, residual = system.solve(at.integrate(move[: mechanism.n]), v + move[mechanism.n :])
            trial_t = float(np.clip(t + step[-1], self.t[0], self.t[-1]))
            trial_gap = self._gap(trial, trial_t)
            solved = residual <= max(RESIDUAL_TOLERANCE, mechanism.tolerance)
            if solved and np.linalg.norm(trial_gap) < np.linalg.norm(gap):
                at, v, t, gap = trial, trial_v, trial_t, trial_gap
                damping = max(damping / 4, MIN_DAMPING)
            else:
                damping *= 8
        if not self._is_on_branch(at, t):
            return None
        q_d = np.asarray(self.desired(t)[0], float)
        kind = classify_solution(SingularSystem(mechanism), at, v).kind
        unit = joined(np.array(mechanism.tree.units())[self.q])
        return NearestSingular(kind, float(np.linalg.norm(gap)), unit, t, q_d, q_d + gap)

    def _gap(self, at: Kinematics, t: float) -> Array:
        """Return q_s - q_d(t), shape (d,)."""
        return np.asarray(self.mechanism.tree.to_coordinates(at.q_tree)[self.q] - self.desired(t)[0])

    def _null_space(self, at: Kinematics, v: Array) -> Array:
        """Return directions (2 n, k) in (q', v) along which a solution stays one to first order."""
        _, sizes, rows = np.linalg.svd(self.system.jacobian(at, v))
        return np.asarray(rows[int(np.sum(sizes > NULL_SPACE_TOLERANCE * sizes[0])) :].T)

    def _is_on_branch(self, at: Kinematics, t: float) -> bool:
        """Whether the straight line in q from the trajectory leads to a solution on the trajectory's branch."""
        nearest = int(np.argmin(np.abs(self.t - t)))
        here = sigma(self.mechanism, self.desired(t)[0], self.path[nearest]).at
        nodes = nodes_at(self.task, here.q_tree[None])
        step = self._gap(at, t)[None] * (1 - CHECK_END) / CHECK_PIECES
        for _ in range(CHECK_PIECES):
            nodes, arrived = follow(self.task, nodes, step)
            if not arrived[0]:
                return False
        end = self.mechanism.kinematics(nodes.q_tree[0])
        end, _, residual = self.system.solve(end, self.system.null_vector(end))
        miss = np.linalg.norm(self._gap(end, t) - self._gap(at, t))
        is_solved = residual <= max(RESIDUAL_TOLERANCE, self.mechanism.tolerance)
        return bool(is_solved and miss <= CHECK_TOLERANCE * np.linalg.norm(self._gap(at, t)))


def _unit_directions(d: int) -> Array:
    """Return unit vectors (count, d): the axes in both directions, and random ones if d > 1."""
    axes = np.vstack([np.eye(d), -np.eye(d)])
    if d == 1:
        return axes
    random = np.random.default_rng(0).standard_normal((DIRECTIONS, d))
    return np.vstack([axes, random / np.linalg.norm(random, axis=1, keepdims=True)])
