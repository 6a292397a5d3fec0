"""Solve a `Task` for many configurations at once: Newton's method with array operations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.kinematics.continuation import MAX_SEARCH_STEP, follow_many, is_local
from ckc_pin.kinematics.extended import Task
from ckc_pin.mechanism.batch import ManyPoses, integrate_many
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "MIN_PIECE",
    "SAME_SHAPE_TOLERANCE",
    "Nodes",
    "find_solutions",
    "follow",
    "nodes_at",
    "shape_points",
    "solve",
]

MAX_ITERATIONS = 8  # of Newton's method
MIN_PIECE = 2.0**-8  # of a path
TOLERANCE = 1e-10  # mechanism sizes: largest |Psi| of a solution
RANDOM_STARTS = 400
MAX_SEARCH_STEPS = 60  # from a random start
SAME_SHAPE_TOLERANCE = 1e-6  # mechanism sizes: distance of all points below which two configurations look the same


Accept = Callable[["Nodes", "Nodes"], BoolArray]


class Nodes(Struct):
    """Solutions of a task, with the Jacobians that continuation needs.

    Attributes
    ----------
    q_tree : (count, nq) array
    values : (count, d) array
        Values of the prescribed rows.
    J : (count, rows, n) array
        Jacobian of all rows.
    det : (count,) array
        Determinant of Psi's Jacobian. A singular configuration lies between two nodes with different signs.
    """

    q_tree: Array
    values: Array
    J: Array
    det: Array

    def __getitem__(self, which: IntArray | BoolArray | slice) -> Nodes:
        return Nodes(self.q_tree[which], self.values[which], self.J[which], self.det[which])

    def joined(self, other: Nodes) -> Nodes:
        """Return these nodes and then the others."""
        return Nodes(*(np.concatenate([getattr(self, x), getattr(other, x)]) for x in ("q_tree", "values", "J", "det")))

    def put(self, which: IntArray | BoolArray, other: Nodes) -> None:
        """Replace some of the nodes."""
        for name in ("q_tree", "values", "J", "det"):
            getattr(self, name)[which] = getattr(other, name)


def nodes_at(task: Task, q_tree: Array) -> Nodes:
    """Return nodes at closed configurations (count, nq)."""
    rows, jacobian = task.evaluate(q_tree)
    return Nodes(q_tree, rows[:, task.rows], jacobian, np.linalg.det(jacobian[:, task.psi_rows]))


def solve(task: Task, start: Array, values: Array, iterations: int = MAX_ITERATIONS) -> tuple[Nodes, BoolArray]:
    """Solve Psi(q') = [0; values] by Newton's method, from starts near the solutions.

    Parameters
    ----------
    task : Task
    start : (count, nq) array
    values : (count, d) array
        Values of the prescribed rows.
    iterations : int

    Returns
    -------
    nodes : Nodes
    is_solved : (count,) array of bool
        False if a step is too long (`is_local`) or does not contract, or Psi's Jacobian is singular.
    """
    mechanism, psi_rows = task.extended.mechanism, task.psi_rows
    tolerance = max(TOLERANCE * max(mechanism.size, 1.0), 10 * mechanism.tolerance)
    count, target = len(start), task.psi_values(values)
    nodes = Nodes(start.copy(), values, np.zeros((count, task.extended.closure.rows, mechanism.n)), np.zeros(count))
    is_solved, active, previous = np.zeros(count, bool), np.arange(count), np.full(count, np.inf)
    for _ in range(iterations):
        rows, jacobian = task.evaluate(nodes.q_tree[active])
        residual = rows[:, psi_rows] - target[active]
        size = np.abs(residual).max(axis=1, initial=0.0)
        done = size <= tolerance
        if np.any(done):
            at = active[done]
            closed = np.abs(rows[done][:, task.extended.loops]).max(axis=1, initial=0.0) <= 10 * tolerance
            nodes.J[at], nodes.det[at] = jacobian[done], np.linalg.det(jacobian[done][:, psi_rows])
            is_solved[at] = closed
        continues = ~done & (size <= 0.5 * previous[active]) & np.isfinite(size)
        previous[active] = size
        step = -_solve(jacobian[continues][:, psi_rows], residual[continues])
        local = is_local(mechanism.tree, step)
        active = active[continues][local]
        if not len(active):
            break
        nodes.q_tree[active] = integrate_many(mechanism.tree, nodes.q_tree[active], step[local])
    return nodes, is_solved


def _solve(matrix: Array, right: Array) -> Array:
    """Solve linear systems (count, n, n), (count, n). The solution of an exactly singular one is infinite."""
    try:
        return np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], dtype=float)
    except np.linalg.LinAlgError:
        is_singular = np.linalg.det(matrix) == 0.0
        solution = np.full(right.shape, np.inf)
        if not np.all(is_singular):
            solution[~is_singular] = np.linalg.solve(matrix[~is_singular], right[~is_singular][:, :, None])[:, :, 0]
        return solution


def follow(
    task: Task, start: Nodes, step: Array, min_piece: float = MIN_PIECE, accept: Accept | None = None
) -> tuple[Nodes, BoolArray]:
    """Change the prescribed values of nodes along straight lines, each node on its branch.

    Parameters
    ----------
    task : Task
    start : Nodes
    step : (count, d) array
        Change of the prescribed values.
    min_piece : float
        A path ends where a piece shorter than this fraction would be needed.
    accept : callable, optional
        Gets the nodes at both ends of pieces. Returns which pieces are accepted; others are shortened.

    Returns
    -------
    nodes : Nodes
    arrived : (count,) array of bool
        False if the branch ends before; the node is then the last one that was reached.
    """
    free, tree = len(task.extended.free), task.extended.mechanism.tree
    at = start[np.arange(len(step))]

    def advance(active: IntArray, done: Array, part: Array) -> BoolArray:
        here = at[active]
        right = np.hstack([np.zeros((len(active), free)), part[:, None] * step[active]])
        prediction = _solve(here.J[:, task.psi_rows], right)
        local = is_local(tree, prediction)
        guess = integrate_many(tree, here.q_tree, np.where(local[:, None], prediction, 0.0))
        trial, is_solved = solve(task, guess, start.values[active] + (done + part)[:, None] * step[active])
        succeeded = is_solved & local & (trial.det * here.det > 0)
        if accept is not None and succeeded.any():
            succeeded[succeeded] = accept(here[succeeded], trial[succeeded])
        at.put(active[succeeded], trial[succeeded])
        return succeeded

    return at, follow_many(len(step), advance, min_piece) == 1.0


def find_solutions(task: Task, values: Array, max_count: int) -> Array:
    """List configurations of different shape with the prescribed values, the assembled branch first.

    The search starts from random configurations, so some solutions may be missed.

    Parameters
    ----------
    task : Task
    values : (d,) array
        Values of the prescribed rows.
    max_count : int
        Largest number of solutions.

    Returns
    -------
    (count, nq) array
    """
    mechanism = task.extended.mechanism
    random = np.random.default_rng(0)
    spread = np.where(mechanism.tree.in_metres, mechanism.size, np.pi)
    steps = random.uniform(-1.0, 1.0, (RANDOM_STARTS, mechanism.n)) * spread
    steps[0] = 0.0
    starts = integrate_many(mechanism.tree, np.tile(mechanism.q_tree, (RANDOM_STARTS, 1)), steps)
    closed = _newton_from_afar(task, starts, np.tile(values, (RANDOM_STARTS, 1)))
    distinct: list[int] = []
    points = shape_points(mechanism, closed)
    for k in range(len(closed)):
        if all(np.abs(points[k] - points[other]).max() > SAME_SHAPE_TOLERANCE * mechanism.size for other in distinct):
            distinct.append(k)
    return closed[distinct[:max_count]]


def _newton_from_afar(task: Task, start: Array, values: Array) -> Array:
    """Solve a task by damped Newton steps of limited length; return the configurations that converged, in order."""
    mechanism, psi_rows, target = task.extended.mechanism, task.psi_rows, task.psi_values(values)
    q_tree = start.copy()
    for _ in range(MAX_SEARCH_STEPS):
        rows, jacobian = task.evaluate(q_tree)
        residual = target - rows[:, psi_rows]
        gram = np.swapaxes(jacobian[:, psi_rows], 1, 2) @ jacobian[:, psi_rows]
        damping = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(mechanism.n)
        gradient = (np.swapaxes(jacobian[:, psi_rows], 1, 2) @ residual[:, :, None])[:, :, 0]
        step = _solve(gram + damping, gradient)
        longest = np.abs(step).max(axis=1, keepdims=True, initial=1e-300)
        if np.all(longest < 1e-12):
            break
        q_tree = integrate_many(mechanism.tree, q_tree, step * np.minimum(1.0, MAX_SEARCH_STEP / longest))
    nodes, is_solved = solve(task, q_tree, values)
    return nodes.q_tree[is_solved]


def shape_points(mechanism: Mechanism, q_tree: Array) -> Array:
    """Return points that describe the shape of a mechanism at configurations (count, nq), shape (count, k).

    They are the centres of mass and the points of the loops. Whole turns of a joint do not change them, nor does the
    rotation of a massless link about its own axis.
    """
    pose = ManyPoses(mechanism.tree, mechanism.closure.anchors, q_tree)
    model, joints = mechanism.tree.model, mechanism.tree.model.njoints
    heavy = np.array([k for k in range(1, joints) if model.inertias[k].mass > 0], np.intp)
    levers = np.array([model.inertias[int(k)].lever for k in heavy]).reshape(-1, 3)
    rotation, translation = pose.rotation.reshape(-1, joints, 3, 3), pose.translation.reshape(-1, joints, 3)
    centres = (rotation[:, heavy] @ levers[:, :, None])[..., 0] + translation[:, heavy]
    points = np.concatenate([centres, pose.p], axis=1)
    return points.reshape(len(q_tree), 3 * points.shape[1])
