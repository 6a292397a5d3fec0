"""The map q' = sigma(q) of eq. 4 by Newton's method with step control, on any level set phi = w; assembly branches.

An integrator has a good initial guess, from which `newton` converges in one or two iterations. From anywhere else,
`sigma` follows the straight line from a closed configuration to q and reports how that ended. `follow_sigma` does the
same for a step of q.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.kinematics.continuation import MAX_SEARCH_STEP, follow, is_local, same_branch
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism

__all__ = [
    "Newton",
    "Sigma",
    "Verdict",
    "assembly_branches",
    "follow_sigma",
    "minimum_norm_step",
    "newton",
    "predict",
    "project_onto_closure",
    "sigma",
]

Verdict = Literal["converged", "out of reach", "singular"]

MAX_ITERATIONS = 12  # of Newton's method
INEXACT_TOLERANCE = 1e-10  # mechanism sizes: a larger tolerance means that redundant rows contradict each other
POLISH_RATIO = 0.1  # then Newton's method goes on while each step reduces the residual at least so much
MAX_PATH_ITERATIONS = 500  # Newton steps to follow a step of a motion: a hundred radians or more
MAX_SEARCH_ITERATIONS = 5000  # Newton steps to follow the line to a q that a user asks for
MIN_PIECE = 1e-9  # of the straight line in q
SINGULAR_CLOSURE_FACTOR = 1e5  # tolerances: how well Newton's method closes a singular configuration
RANDOM_STARTS = 20  # values of z from which q is searched if the line does not lead there
SINGULAR_MARGIN = 1e-9  # of `Kinematics.margin`: below it phi_z is singular to working precision
SINGULAR_ON_PATH_MARGIN = 1e-3  # the same where a path ends
SINGULAR_IN_SEARCH_MARGIN = 1e-6  # the same where a search ends
MAX_SEARCH_STEPS = 60  # Newton steps from a random start to a branch
BRANCH_STARTS = 400  # random values of z from which assembly branches are searched
MAX_BRANCH_COORDINATES = 12  # dependent coordinates; with more, random starts would miss most branches
BRANCH_DISTANCE = 1e-6  # rad or m: configurations closer than this are the same branch


class Newton(Struct, frozen=True):
    """Outcome of Newton's method on z.

    Attributes
    ----------
    at : Kinematics
        The last iterate.
    iterations : int
    converged : bool
    """

    at: Kinematics
    iterations: int
    converged: bool


class Sigma(Struct, frozen=True):
    """Outcome of the search for q' = sigma(q).

    Attributes
    ----------
    verdict : "converged", "out of reach" or "singular"
    at : Kinematics
        At sigma(q) if converged, otherwise the last closed configuration on the line to q.
    reached : float
        Fraction of the straight line that could be followed. It is less than 1 also if sigma(q) was found by a search
        from other starts, on the same branch according to the sign of det phi_z.
    miss : float
        Smallest value of the largest |phi - w| at q if out of reach, metres or radians; NaN if it was not computed.
    iterations : int
        Newton iterations in total.
    reason : str
        Explanation of the verdict, for messages.
    """

    verdict: Verdict
    at: Kinematics
    reached: float
    miss: float
    iterations: int
    reason: str = ""


def sigma(
    mechanism: Mechanism,
    q: Array,
    start: Kinematics | None = None,
    w: Array | float = 0.0,
    *,
    anywhere: bool = True,
) -> Sigma:
    """Return q' = sigma(q), eq. 4, on the assembly branch of a closed configuration.

    Parameters
    ----------
    mechanism : Mechanism
    q : (d,) array
        The independent coordinates, rad or m.
    start : Kinematics, optional
        A closed configuration. Default: as assembled.
    w : (rows,) array or 0.0
        The level set phi = w.
    anywhere : bool
        Whether to search for q from other starts if the straight line ends before q.

    Raises
    ------
    InputError
        The loops constrain a free root in part, so the mechanism has no independent coordinates q.
    """
    if mechanism.splits_root:
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    start = start or mechanism.assembled
    if mechanism.tree.is_euclidean:
        step = q - start.q_tree[mechanism.tree.q_index[mechanism.partition.q]]
    else:
        numbers = mechanism.tree.to_coordinates(start.q_tree)
        numbers[mechanism.partition.q] = q
        step = mechanism.tree.difference(start.q_tree, mechanism.tree.from_coordinates(numbers))[mechanism.partition.q]
    return follow_sigma(start, step, w, mechanism.tolerance, anywhere=anywhere)


def newton(start: Kinematics, w: Array | float, tolerance: float) -> Newton:
    """Solve phi(q, z) = w for z by Newton's method, from a start near the solution.

    Parameters
    ----------
    start : Kinematics
        Provides q and the initial z.
    w : (rows,) array or 0.0
        The level set phi = w.
    tolerance : float
        Largest |phi - w| that counts as closed. It is increased for large coordinates (`Tree.tolerance_factor`). If it
        is loose because redundant rows contradict each other, the iteration goes on until z closes the rows to
        rounding, so that the result does not depend on the start.

    Returns
    -------
    Newton
        Not converged if a step is too long (`is_local`), does not contract, or phi_z is singular.
    """
    at, is_inexact = start, tolerance > INEXACT_TOLERANCE * start.tree.size
    tolerance *= start.tree.tolerance_factor(start.q_tree)
    residual = at.phi - w
    size = _reducible_residual(at, residual)
    has_redundant_rows = len(residual) > len(at.partition.z)
    polish = has_redundant_rows and is_inexact and size > 0.0
    for iteration in range(MAX_ITERATIONS):
        closed = size <= tolerance
        if closed and not polish:
            return Newton(at, iteration, True)
        if not np.isfinite(size) or at.phi_z_factor.singular:
            return Newton(at, iteration, closed)
        step = np.zeros(at.tree.n)
        step[at.partition.z] = -at.phi_z_factor.solve(residual)
        if not is_local(at.tree, step):
            return Newton(at, iteration, False)
        at = at.integrate(step)
        residual = at.phi - w
        previous, size = size, _reducible_residual(at, residual)
        if not size <= max(0.5 * previous, tolerance):
            return Newton(at, iteration + 1, False)
        polish = polish and size < POLISH_RATIO * previous
    return Newton(at, MAX_ITERATIONS, size <= tolerance)


def project_onto_closure(start: Kinematics, rank: int, fixed: Sequence[int] | IntArray = ()) -> Kinematics:
    """Project a configuration onto phi = 0 by minimum-norm Newton steps in all coordinates, until these do not improve.

    Parameters
    ----------
    start : Kinematics
        A nearly closed configuration.
    rank : int
        Rank of J with a row for each fixed coordinate.
    fixed : sequence of int
        Coordinates that do not move.
    """
    at, rows = start, np.eye(start.tree.n)[list(fixed)]
    size, none = float(np.abs(at.phi).max(initial=0.0)), np.zeros(len(rows))
    for _ in range(MAX_ITERATIONS if size > 0.0 else 0):
        step = minimum_norm_step(np.vstack([at.J, rows]), rank, np.concatenate([at.phi, none]), at.tree.step_scale)
        trial = at.integrate(step)
        previous, size = size, float(np.abs(trial.phi).max())
        if not size < previous:
            break
        at = trial
    return at


def minimum_norm_step(rows: Array, rank: int, residual: Array, scale: Array) -> Array:
    """Return the x of minimum norm with rows x = -residual. Norms are of x / scale, so lengths and angles compare."""
    u, values, v = np.linalg.svd(rows * scale, full_matrices=False)
    components = (u[:, :rank].T @ residual) / np.maximum(values[:rank], 1e-300)
    return np.asarray(-scale * (v[:rank].T @ components))


def _reducible_residual(at: Kinematics, residual: Array) -> float:
    """Return the largest entry of the part of a residual that a change of z can reduce.

    Redundant rows contradict each other slightly if the numbers of a file are rounded. Then no configuration closes all
    of them.
    """
    if len(residual) > len(at.partition.z) and np.all(np.isfinite(residual)) and not at.phi_z_factor.singular:
        residual = at.phi_z @ at.phi_z_factor.solve(residual)
    return float(np.abs(residual).max(initial=0.0))


def predict(at: Kinematics, dq: Array, dw: Array | None = None) -> Kinematics:
    """Return the first-order prediction for a step dq and a change dw of the level: z + rho_z dq + phi_z^-1 dw."""
    step = at.rho @ dq
    if dw is not None:
        step[at.partition.z] += at.phi_z_factor.solve(dw)
    return at.integrate(step)


def follow_sigma(start: Kinematics, dq: Array, w: Array | float, tolerance: float, *, anywhere: bool = True) -> Sigma:
    """Follow q' = sigma(q) along the straight line to q + dq, and from the level of the start to w.

    Each piece is predicted with rho and corrected by Newton's method. If the line ends early, q + dq is searched from
    other starts, unless `anywhere` is False.
    """
    dw, iterations, max_iterations = w - start.phi, 0, MAX_SEARCH_ITERATIONS if anywhere else MAX_PATH_ITERATIONS
    between_levels = bool(np.abs(dw).max(initial=0.0) > tolerance)

    def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
        nonlocal iterations
        if iterations > max_iterations or at.phi_z_factor.singular:
            return None
        level = w - (1.0 - done - part) * dw if between_levels else w
        trial = newton(predict(at, part * dq, part * dw if between_levels else None), level, tolerance)
        iterations += trial.iterations
        return trial.at if trial.converged else None

    at, done = follow(start, advance, MIN_PIECE)
    if done < 1.0 and anywhere:
        return _search(at, (1.0 - done) * dq, w, tolerance, done, iterations)
    if iterations > max_iterations:
        return Sigma("out of reach", at, done, float("nan"), iterations, "it is too far away for one step")
    if done < 1.0:
        return _end_of_line(at, done, iterations)
    if at.margin() <= SINGULAR_MARGIN:
        return Sigma("singular", at, 1.0, 0.0, iterations, "phi_z is singular there")
    return Sigma("converged", at, 1.0, 0.0, iterations)


def _end_of_line(at: Kinematics, done: float, iterations: int) -> Sigma:
    miss = float("nan")
    if at.margin() <= SINGULAR_ON_PATH_MARGIN:
        return Sigma("singular", at, done, miss, iterations, "phi_z is singular on the way")
    return Sigma("out of reach", at, done, miss, iterations, "the loops cannot be kept closed on the way")


def _search(at: Kinematics, dq: Array, w: Array | float, tolerance: float, done: float, iterations: int) -> Sigma:
    """Search for sigma(q) where the straight line to q ended: from z at its end, then from random z.

    Beyond a region that is out of reach q may still be on this branch, which the sign of det phi_z shows.
    """
    target = np.zeros(at.tree.n)
    target[at.partition.q] = dq
    tolerance *= at.tree.tolerance_factor(at.integrate(target).q_tree)
    start, random = at.integrate(target), np.random.default_rng(0)
    smallest_miss, is_singular, on_other_branch = np.inf, False, False
    for attempt in range(RANDOM_STARTS):
        spread = np.zeros(at.tree.n)
        spread[at.partition.z] = random.uniform(-np.pi, np.pi, len(at.partition.z)) if attempt else 0.0
        spread *= at.tree.step_scale
        trial = _least_squares(start.integrate(spread), w, tolerance)
        miss = float(np.abs(trial.phi - w).max(initial=0.0))
        smallest_miss = min(smallest_miss, miss)
        has_singular_phi_z = trial.margin() <= SINGULAR_IN_SEARCH_MARGIN
        if miss <= tolerance and not has_singular_phi_z:
            if same_branch(at, trial):
                return Sigma("converged", trial, done, 0.0, iterations)
            on_other_branch = True
        is_singular = is_singular or (has_singular_phi_z and miss <= SINGULAR_CLOSURE_FACTOR * tolerance)
    if is_singular:
        return Sigma("singular", at, done, smallest_miss, iterations, "phi_z is singular there")
    if on_other_branch:
        reason = "the loops close there on another assembly branch only, behind a singular configuration"
    else:
        reason = f"the loops cannot close there (nearest miss {smallest_miss:.3g})"
    return Sigma("out of reach", at, done, smallest_miss, iterations, reason)


def _least_squares(at: Kinematics, w: Array | float, tolerance: float) -> Kinematics:
    """Minimize |phi - w| over z by the Levenberg-Marquardt method."""
    damping, z = 1e-3, at.partition.z
    for _ in range(200):
        residual = at.phi - w
        if np.abs(residual).max(initial=0.0) <= tolerance:
            break
        gram, gradient = at.phi_z.T @ at.phi_z, at.phi_z.T @ residual
        step = np.zeros(at.tree.n)
        step[z] = -np.linalg.solve(gram + damping * np.eye(len(z)) * max(1e-30, np.trace(gram)), gradient)
        trial = at.integrate(step)
        if np.linalg.norm(trial.phi - w) < np.linalg.norm(residual):
            at, damping = trial, max(damping / 5, 1e-12)
            if np.abs(step).max() < 1e-12:
                break
        else:
            damping *= 4
            if damping > 1e12:
                break
    return at


# --- assembly branches ---------------------------------------------------------------------------


def assembly_branches(mechanism: Mechanism, at: Kinematics | None = None) -> list[Kinematics]:
    """List the assembly branches at the q of a closed configuration, this one first, by a search from random z.

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics, optional
        The configuration. Default: as assembled.

    Raises
    ------
    InputError
        The mechanism is too large for a search from random starts.
    """
    at = at or mechanism.assembled
    z = mechanism.partition.z
    if len(z) > MAX_BRANCH_COORDINATES or not mechanism.tree.is_euclidean:
        raise InputError(
            f"{mechanism.name}: branches are listed for mechanisms with at most {MAX_BRANCH_COORDINATES} dependent "
            f"joints{'' if mechanism.tree.is_euclidean else ' and without a free root'}; this one has {len(z)}"
        )
    random = np.random.default_rng(0)
    spread = np.where(mechanism.tree.in_metres[z], mechanism.size, np.pi)
    starts = np.tile(at.q_tree, (BRANCH_STARTS if len(z) else 0, 1))
    starts[:, mechanism.tree.q_index[z]] += random.uniform(-1.0, 1.0, (len(starts), len(z))) * spread
    branches = [at]
    for q_tree in _close_many(at, starts, mechanism.tolerance):
        if _is_distinct(mechanism, q_tree, np.array([branch.q_tree for branch in branches])):
            outcome = newton(Kinematics(at.tree, at.closure, at.partition, q_tree), 0.0, mechanism.tolerance)
            branches += [outcome.at] if outcome.converged else []
    return branches


def _close_many(at: Kinematics, starts: Array, tolerance: float) -> Array:
    """Close the loops by Newton steps on z of limited length, from all starts (count, nq) together.

    Returns
    -------
    (k, nq) array
        The closed configurations, in the order of their starts.
    """
    z, q_tree, is_open = at.partition.z, starts.copy(), np.ones(len(starts), bool)
    tolerance *= at.tree.tolerance_factor(at.q_tree)
    for _ in range(MAX_SEARCH_STEPS):
        phi, J = evaluate_closure(at.tree, at.closure, q_tree[is_open])
        continues = np.abs(phi).max(axis=1, initial=0.0) > tolerance
        is_open[is_open] = continues
        if not np.any(is_open):
            break
        step = (np.linalg.pinv(J[continues][:, :, z], rtol=1e-6) @ -phi[continues][:, :, None])[:, :, 0]
        longest = np.abs(step).max(axis=1, keepdims=True, initial=1e-300)
        q_tree[np.ix_(is_open, at.tree.q_index[z])] += step * np.minimum(1.0, MAX_SEARCH_STEP / longest)
    return q_tree[~is_open]


def _is_distinct(mechanism: Mechanism, q_tree: Array, others: Array) -> bool:
    """Whether a configuration (nq,) differs from others (count, nq) by more than whole turns of joints."""
    gap, angles = q_tree - others, ~mechanism.tree.in_metres
    gap[:, angles] = np.remainder(gap[:, angles] + np.pi, 2 * np.pi) - np.pi
    return bool(np.abs(gap).max(axis=1).min() > BRANCH_DISTANCE)
