"""Close the loops of a tree near a guess by the damped Gauss-Newton method."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.base.sparse import factorize_full_row_rank
from ckc_pin.kinematics.continuation import MAX_NEWTON_STEP
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.tree import Tree

__all__ = ["EXACT_TOLERANCE", "ROUNDED_TOLERANCE", "Assembly", "close_loops", "find_nearby"]

RESTARTS = 20  # from perturbed guesses
MAX_ITERATIONS = 100  # of the Gauss-Newton method
STALL_ITERATIONS = 6  # from a perturbed guess: a smaller decrease of |phi| in so many steps counts as a local minimum
STALL_DECREASE = 0.01  # relative
MIN_STEP = 1e-14  # rad, or mechanism sizes: a shorter step is lost in the rounding of a configuration
EXACT_TOLERANCE = 1e-10  # mechanism sizes: largest |phi| of a closed mechanism whose numbers are exact
ROUNDED_TOLERANCE = 1e-5  # the same with numbers rounded to six digits in the files: 2.35619 rad is off by 5e-6
NEARBY_STEP = 0.02  # rad, or mechanism sizes: distance at which the rank near a closed configuration is computed
NEARBY_COUNT = 2  # configurations at about that distance
MIN_NEARBY_RATIO = 0.1  # of a configuration's distance to NEARBY_STEP, to be counted
MAX_DIRECTIONS = 20  # in which they are searched


class Assembly(Struct, frozen=True):
    """Outcome of an assembly.

    Attributes
    ----------
    q_tree : (nq,) array
        The best configuration.
    residual : float
        Largest |phi| there, or excess over a bound.
    largest_residuals : dict of str to float
        Largest |phi| of each loop.
    """

    q_tree: Array
    residual: float
    largest_residuals: dict[str, float]


def close_loops(
    tree: Tree,
    closure: Closure,
    q_tree: Array,
    free: Array,
    tolerance: float,
    restarts: int = RESTARTS,
    bounds: tuple[Array, Array] | None = None,
    rounded: float = 0.0,
    may_restart: Callable[[], bool] = lambda: True,
) -> Assembly:
    """Close the loops near a guess by the damped Gauss-Newton method, with minimum-norm steps.

    Parameters
    ----------
    tree, closure : Tree, Closure
    q_tree : (nq,) array
        The guess.
    free : (n,) array of 0 or 1
        1 for coordinates that may move. The others keep their guess.
    tolerance : float
        Largest |phi| that counts as closed.
    restarts : int
        Number of perturbed guesses to try if the guess itself does not lead to a closed configuration.
    bounds : pair of (n,) arrays, or None
        Bounds of the coordinates. The excess over a bound counts as a residual, in its own unit.
    rounded : float
        Largest |phi| that is accepted if rows contradict each other so much. Other guesses are not tried then, since
        they would lead to a different configuration with a slightly smaller residual.
    may_restart : function
        Called if the guess does not lead to a closed configuration: whether others are tried.

    Returns
    -------
    Assembly
        From the guess if that closes, otherwise from the first perturbed guess that closes, or the best one.
    """

    def evaluate(q: Array) -> tuple[Array, Callable[[], Array]]:
        pose = Pose(tree, closure.anchors, q)
        phi = closure.phi(pose)
        if bounds is None:
            return phi, lambda: closure.jacobian(pose) * free
        numbers = tree.to_coordinates(q)
        beyond = numbers - np.clip(numbers, *bounds)
        rows = np.eye(tree.n)[beyond != 0]
        return np.concatenate([phi, beyond[beyond != 0]]), lambda: np.vstack([closure.jacobian(pose), rows]) * free

    def outcome(start: Array, open_norm: float = np.inf) -> tuple[Assembly, bool]:
        """Return the assembly from a guess, and whether it is accepted. It may stall with |phi| > open_norm."""
        q = _gauss_newton(tree, start, evaluate, tolerance, open_norm)
        phi, _ = evaluate(q)
        open_, excess = (float(np.abs(part).max(initial=0.0)) for part in np.split(phi, [closure.rows]))
        assembly = Assembly(q, max(open_, excess), closure.largest_residuals(phi[: closure.rows]))
        return assembly, open_ <= max(tolerance, rounded) and excess <= tolerance

    best, closed = outcome(q_tree)
    if closed or not restarts or not may_restart():
        return best
    random = np.random.default_rng(0)  # a fixed seed, so that the result is reproducible
    for attempt in range(restarts):
        spread = 0.1 * 1.4**attempt
        step = free * tree.step_scale * random.uniform(-spread, spread, tree.n)
        trial, closed = outcome(tree.integrate(q_tree, step), max(tolerance, rounded))
        if closed or trial.residual < best.residual:
            best = trial
        if closed:
            break
    return best


def _gauss_newton(
    tree: Tree,
    q: Array,
    evaluate: Callable[[Array], tuple[Array, Callable[[], Array]]],
    tolerance: float,
    open_norm: float,
) -> Array:
    """Minimize |phi| by minimum-norm Newton steps, each shortened until |phi| decreases.

    `evaluate` returns phi and a function that returns its Jacobian. The iteration ends if it stalls at a larger |phi|
    than `open_norm`.
    """
    phi, jacobian = evaluate(q)
    norms: list[float] = []
    for _ in range(MAX_ITERATIONS):
        if np.abs(phi).max(initial=0.0) <= 1e-3 * tolerance:
            break
        norms.append(float(np.linalg.norm(phi)))
        if len(norms) > STALL_ITERATIONS:
            stalled = norms[-1] > (1 - STALL_DECREASE) * norms[-1 - STALL_ITERATIONS]
            if stalled and norms[-1] > open_norm:
                break
        part = -_minimum_norm_solution(jacobian() * tree.step_scale, phi)
        longest, step = float(np.abs(part).max(initial=0.0)), part * tree.step_scale
        if longest <= MIN_STEP:
            break
        scale = min(1.0, MAX_NEWTON_STEP / longest)
        while scale > 1e-6:
            trial = tree.integrate(q, scale * step)
            phi_trial, jacobian_trial = evaluate(trial)
            if np.linalg.norm(phi_trial) < (1 - 1e-4 * scale) * norms[-1]:
                q, phi, jacobian = trial, phi_trial, jacobian_trial
                break
            scale /= 2
        else:
            break
    return q


def _minimum_norm_solution(jacobian: Array, phi: Array) -> Array:
    full = factorize_full_row_rank(jacobian)
    return full.minimum_norm(phi) if full else np.asarray(np.linalg.lstsq(jacobian, phi, rcond=1e-6)[0], dtype=float)


def find_nearby(tree: Tree, closure: Closure, q_tree: Array, tangent: Array, accept: float) -> list[Array]:
    """Return configurations with closed loops that are about `NEARBY_STEP` away from `q_tree`, along its tangent space.

    There may be none: at a singular position, the loops close along some directions only.
    """
    random = Random(0)  # a check of every mechanism: NumPy's generators take longer to import than the check
    configurations, moved = [], 0
    for _ in range(MAX_DIRECTIONS if len(tangent) else 0):
        step = np.array([random.uniform(-1.0, 1.0) for _ in tangent]) @ tangent
        step *= NEARBY_STEP / np.abs(step).max() * tree.step_scale
        closed = close_loops(tree, closure, tree.integrate(q_tree, step), np.ones(tree.n), accept, restarts=0)
        if closed.residual <= 10 * accept:
            configurations.append(closed.q_tree)
            change = tree.difference(q_tree, closed.q_tree) / tree.step_scale
            moved += float(np.abs(change).max()) >= MIN_NEARBY_RATIO * NEARBY_STEP
        if moved == NEARBY_COUNT:
            break
    return configurations
