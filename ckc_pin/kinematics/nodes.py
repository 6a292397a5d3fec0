"""Many configurations moved at once to given values of a `Task`: Newton's method by array operations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.kinematics.continuation import follow_many
from ckc_pin.kinematics.extended import Task
from ckc_pin.mechanism.batch import ManyPoses, integrate_many
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["SHORTEST", "Nodes", "find_solutions", "follow", "nodes_at", "shape_points", "solve"]

MAX_STEP = 0.5  # rad, or of the mechanism's size: a longer Newton step in one coordinate is not local any more
ITERATIONS = 8
SHORTEST = 2.0**-8  # of a way
TOLERANCE = 1e-10  # of |Psi| in units of the mechanism's size
STARTS = 400
WALK = 0.3  # rad or m: longest step of a search from a random start
SAME = 1e-6  # of the mechanism's size


@dataclass
class Nodes:
    """Configurations and what following them needs.

    Attributes
    ----------
    q_tree : (count, nq) array
    given : (count, d) array
        The values of the given rows.
    J : (count, rows, n) array
        Of all rows.
    det : (count,) array
        Of Psi's Jacobian; where it changes sign there is a singular configuration between.
    """

    q_tree: Array
    given: Array
    J: Array
    det: Array

    def __getitem__(self, which: IntArray | BoolArray) -> Nodes:
        return Nodes(self.q_tree[which], self.given[which], self.J[which], self.det[which])

    def put(self, which: IntArray | BoolArray, other: Nodes) -> None:
        """Replace some."""
        for name in ("q_tree", "given", "J", "det"):
            getattr(self, name)[which] = getattr(other, name)


def nodes_at(task: Task, q_tree: Array) -> Nodes:
    """Return closed configurations (count, nq) as nodes."""
    rows, jacobian = task.evaluate(q_tree)
    return Nodes(q_tree, rows[:, task.rows], jacobian, np.linalg.det(jacobian[:, task.every]))


def solve(task: Task, start: Array, given: Array, iterations: int = ITERATIONS) -> tuple[Nodes, BoolArray]:
    """Newton on Psi(q') = [0; given] from starts near by.

    Parameters
    ----------
    task : Task
    start : (count, nq) array
    given : (count, d) array

    Returns
    -------
    nodes : Nodes
    solved : (count,) array of bool
        False where a step is not local or does not contract, or Psi's Jacobian is singular.
    """
    mechanism, every = task.extended.mechanism, task.every
    tolerance = max(TOLERANCE * max(mechanism.size, 1.0), 10 * mechanism.tolerance)
    count, level = len(start), task.level(given)
    found = Nodes(start.copy(), given, np.zeros((count, task.extended.closure.rows, mechanism.n)), np.zeros(count))
    solved, active, left = np.zeros(count, bool), np.arange(count), np.full(count, np.inf)
    for _ in range(iterations):
        rows, jacobian = task.evaluate(found.q_tree[active])
        residual = rows[:, every] - level[active]
        size = np.abs(residual).max(axis=1, initial=0.0)
        done = size <= tolerance
        if np.any(done):
            at = active[done]
            closed = np.abs(rows[done][:, task.extended.loops]).max(axis=1, initial=0.0) <= 10 * tolerance
            found.J[at], found.det[at] = jacobian[done], np.linalg.det(jacobian[done][:, every])
            solved[at] = closed
        going = ~done & (size <= 0.5 * left[active]) & np.isfinite(size)
        left[active] = size
        step = -_solve(jacobian[going][:, every], residual[going])
        local = np.abs(step / mechanism.tree.step_scale).max(axis=1, initial=0.0) <= MAX_STEP
        active = active[going][local]
        if not len(active):
            break
        found.q_tree[active] = integrate_many(mechanism.tree, found.q_tree[active], step[local])
    return found, solved


def _solve(matrix: Array, right: Array) -> Array:
    """Solve many systems (count, n, n), (count, n); those that are exactly singular give infinity."""
    try:
        return np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], dtype=float)
    except np.linalg.LinAlgError:
        bad = np.linalg.det(matrix) == 0.0
        solution = np.full(right.shape, np.inf)
        if not np.all(bad):
            solution[~bad] = np.linalg.solve(matrix[~bad], right[~bad][:, :, None])[:, :, 0]
        return solution


def follow(task: Task, start: Nodes, change: Array, shortest: float = SHORTEST) -> tuple[Nodes, BoolArray]:
    """Change the given values of nodes along straight lines, each on its branch.

    Parameters
    ----------
    task : Task
    start : Nodes
    change : (count, d) array
    shortest : float
        Where pieces shorter than this part of a way would be needed it is taken to end.

    Returns
    -------
    nodes : Nodes
    arrived : (count,) array of bool
        Where False the branch ends on the way; the node is the last one that was reached.
    """
    free, tree = len(task.extended.free), task.extended.mechanism.tree
    at = start[np.arange(len(change))]

    def advance(active: IntArray, done: Array, part: Array) -> BoolArray:
        here = at[active]
        right = np.hstack([np.zeros((len(active), free)), part[:, None] * change[active]])
        step = _solve(here.J[:, task.every], right)
        near = np.abs(step / tree.step_scale).max(axis=1) <= MAX_STEP
        guess = integrate_many(tree, here.q_tree, np.where(near[:, None], step, 0.0))
        trial, solved = solve(task, guess, start.given[active] + (done + part)[:, None] * change[active])
        good = solved & near & (trial.det * here.det > 0)
        at.put(active[good], trial[good])
        return good

    return at, follow_many(len(change), advance, shortest) == 1.0


def find_solutions(task: Task, given: Array, most: int) -> Array:
    """List configurations with these given values, as different shapes, the assembled one's branch first.

    They are found from random starts, so that some may be missed.

    Parameters
    ----------
    task : Task
    given : (d,) array
    most : int
        How many at most.

    Returns
    -------
    (count, nq) array
    """
    mechanism = task.extended.mechanism
    random = np.random.default_rng(0)
    reach = np.where(mechanism.tree.in_metres, mechanism.size, np.pi)
    steps = random.uniform(-1.0, 1.0, (STARTS, mechanism.n)) * reach
    steps[0] = 0.0
    starts = integrate_many(mechanism.tree, np.tile(mechanism.q_tree, (STARTS, 1)), steps)
    closed = _settle(task, starts, np.tile(given, (STARTS, 1)))
    found: list[int] = []
    look = shape_points(mechanism, closed)
    for k in range(len(closed)):
        if all(np.abs(look[k] - look[other]).max() > SAME * mechanism.size for other in found):
            found.append(k)
    return closed[found[:most]]


def _settle(task: Task, start: Array, given: Array) -> Array:
    """Newton with steps cut to what is local; return the configurations that close, in order."""
    mechanism, every, level = task.extended.mechanism, task.every, task.level(given)
    q_tree = start.copy()
    for _ in range(60):
        rows, jacobian = task.evaluate(q_tree)
        residual = level - rows[:, every]
        gram = np.swapaxes(jacobian[:, every], 1, 2) @ jacobian[:, every]
        damping = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(mechanism.n)
        gradient = (np.swapaxes(jacobian[:, every], 1, 2) @ residual[:, :, None])[:, :, 0]
        step = _solve(gram + damping, gradient)
        longest = np.abs(step).max(axis=1, keepdims=True, initial=1e-300)
        if np.all(longest < 1e-12):
            break
        q_tree = integrate_many(mechanism.tree, q_tree, step * np.minimum(1.0, WALK / longest))
    nodes, solved = solve(task, q_tree, given)
    return nodes.q_tree[solved]


def shape_points(mechanism: Mechanism, q_tree: Array) -> Array:
    """What a mechanism looks like at configurations (count, nq): centres of mass and ends of loops, (count, k).

    Whole turns of a joint do not show, nor do joints of a massless link that only say how it is held.
    """
    pose = ManyPoses(mechanism.tree, mechanism.closure.anchors, q_tree)
    model, joints = mechanism.tree.model, mechanism.tree.model.njoints
    heavy = np.array([k for k in range(1, joints) if model.inertias[k].mass > 0], np.intp)
    levers = np.array([model.inertias[int(k)].lever for k in heavy]).reshape(-1, 3)
    rotation, translation = pose.rotation.reshape(-1, joints, 3, 3), pose.translation.reshape(-1, joints, 3)
    centres = (rotation[:, heavy] @ levers[:, :, None])[..., 0] + translation[:, heavy]
    points = np.concatenate([centres, pose.p], axis=1)
    return points.reshape(len(q_tree), 3 * points.shape[1])
