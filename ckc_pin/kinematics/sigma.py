"""The map q' = sigma(q) of eq. 4, by Newton with step control, on any level set phi = w.

Two uses. Inside an integration a good prediction is at hand: `newton` alone, one or two iterations.
From anywhere else: `sigma` follows the straight line from a closed configuration to the wanted q and
says how that ended, `move` the same for a step of q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.kinematics.continuation import follow, same_branch
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

MAX_STEP = 0.5  # rad, or of the mechanism's size: a longer Newton step in one coordinate is not local any more
MAX_ITERATIONS = 12
LOOSE = 1e-10  # of the mechanism's size: a tolerance beyond that is what contradicting rows leave open, not rounding
GAINS = 0.1  # with such a one, Newton's method goes on while a step leaves no more
FAR = 500  # Newton steps, a hundred radians or more: no step of a motion is so long, but a trial of one may be
FARTHEST = 5000  # the same for a q that somebody asks for; what is further is looked for without the way there
SMALLEST_PIECE = 1e-9  # of the straight line in q
NEARLY = 1e5  # tolerances: as closed as Newton's method makes a singular configuration
STARTS = 20  # of z, when the line does not lead to q
ROUNDING = 1e-9  # of |J|: below that, phi_z is singular to working precision


@dataclass(frozen=True)
class Newton:
    """Outcome of Newton's iteration on z: the last iterate, how many corrections, whether it closed."""

    at: Kinematics
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Sigma:
    """Outcome of following sigma to a wanted q.

    Attributes
    ----------
    verdict : "converged", "out of reach" or "singular"
    at : Kinematics
        At sigma(q) when converged, else at the last closed configuration of the way.
    reached : float
        How much of the straight line could be followed; less than 1 also for a q that was found converged
        without the line, on the same branch by the sign of det phi_z alone.
    miss : float
        Largest |phi - w| that remains at q when out of reach, metres or radians.
    iterations : int
        Newton corrections over the whole way.
    reason : str
        The verdict as half a sentence.
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
    """Return q' = sigma(q), eq. 4, on the assembly branch of `start` (default: as assembled).

    Parameters
    ----------
    mechanism : Mechanism
    q : (d,) array
        The independent coordinates, rad or m.
    start : Kinematics, optional
        Closed.
    w : (rows,) array or 0.0
        The level set.
    anywhere : bool
        Where the straight way to q ends early, whether to look for q from other starts.

    Raises
    ------
    InputError
        The loops constrain a free root in part: its place is no function of numbers q.
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
    """Close phi(q, z) = w by Newton on z from a start near the solution.

    Parameters
    ----------
    start : Kinematics
        Its q is kept, its z corrected.
    w : (rows,) array or 0.0
        The level set.
    tolerance : float
        Largest |phi - w| that counts as closed, where coordinates are not large (`Tree.coarseness`). Where it is loose
        because rows contradict each other, what z can close is closed to rounding: of how far a start was off, nothing
        stays.

    Returns
    -------
    Newton
        Not converged when a step is not local, does not contract, or phi_z is singular.
    """
    at, loose = start, tolerance > LOOSE * start.tree.size
    tolerance *= start.tree.tolerance_factor(start.q_tree)
    residual = at.phi - w
    size = _unclosed(at, residual)
    redundant = len(residual) > len(at.partition.z)
    polish = redundant and loose and size > 0.0
    for iteration in range(MAX_ITERATIONS):
        closed = size <= tolerance
        if closed and not polish:
            return Newton(at, iteration, True)
        if not np.isfinite(size) or at.phi_z_factor.singular:
            return Newton(at, iteration, closed)
        step = np.zeros(at.tree.n)
        step[at.partition.z] = -at.phi_z_factor.solve(residual)
        if not np.abs(step / at.tree.step_scale).max() <= MAX_STEP:
            return Newton(at, iteration, False)
        at = at.integrate(step)
        residual = at.phi - w
        previous, size = size, _unclosed(at, residual)
        if not size <= max(0.5 * previous, tolerance):
            return Newton(at, iteration + 1, False)
        polish = polish and size < GAINS * previous
    return Newton(at, MAX_ITERATIONS, size <= tolerance)


def project_onto_closure(start: Kinematics, rank: int, still: Sequence[int] | IntArray = ()) -> Kinematics:
    """Close the loops by the shortest steps, q and z alike, as far as these lead.

    Parameters
    ----------
    start : Kinematics
        Nearly closed.
    rank : int
        Of J and the rows of what stands still together.
    still : sequence of int
        Coordinates that do not move.
    """
    at, rows = start, np.eye(start.tree.n)[list(still)]
    size, none = float(np.abs(at.phi).max(initial=0.0)), np.zeros(len(rows))
    for _ in range(MAX_ITERATIONS if size > 0.0 else 0):
        step = minimum_norm_step(np.vstack([at.J, rows]), rank, np.concatenate([at.phi, none]), at.tree.step_scale)
        trial = at.integrate(step)
        previous, size = size, float(np.abs(trial.phi).max())
        if not size < previous:
            break
        at = trial
    return at


def minimum_norm_step(rows: Array, rank: int, residual: Array, reach: Array) -> Array:
    """Return the least x with rows x = -residual, radians and the mechanism's size being alike."""
    u, values, v = np.linalg.svd(rows * reach, full_matrices=False)
    along = (u[:, :rank].T @ residual) / np.maximum(values[:rank], 1e-300)
    return np.asarray(-reach * (v[:rank].T @ along))


def _unclosed(at: Kinematics, residual: Array) -> float:
    """Largest part of a residual that z could still close.

    With redundant rows some of it may be out of z's reach: where the numbers of a file are rounded the
    rows contradict each other slightly, and no configuration closes them all.
    """
    if len(residual) > len(at.partition.z) and np.all(np.isfinite(residual)) and not at.phi_z_factor.singular:
        residual = at.phi_z @ at.phi_z_factor.solve(residual)
    return float(np.abs(residual).max(initial=0.0))


def predict(at: Kinematics, dq: Array, dw: Array | None = None) -> Kinematics:
    """Move q by dq, the level by dw, and z along with them to first order, z + rho_z dq + phi_z^-1 dw."""
    step = at.rho @ dq
    if dw is not None:
        step[at.partition.z] += at.phi_z_factor.solve(dw)
    return at.integrate(step)


def follow_sigma(start: Kinematics, dq: Array, w: Array | float, tolerance: float, *, anywhere: bool = True) -> Sigma:
    """Follow q' = sigma(q) along the straight line from a closed configuration to q + dq, and from its level to w.

    Each piece is predicted along rho and corrected by Newton. Where the line ends early, q is looked for from other
    starts, unless `anywhere` is False.
    """
    dw, iterations, most = w - start.phi, 0, FARTHEST if anywhere else FAR
    between_levels = bool(np.abs(dw).max(initial=0.0) > tolerance)

    def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
        nonlocal iterations
        if iterations > most or at.phi_z_factor.singular:
            return None
        level = w - (1.0 - done - part) * dw if between_levels else w
        trial = newton(predict(at, part * dq, part * dw if between_levels else None), level, tolerance)
        iterations += trial.iterations
        return trial.at if trial.converged else None

    at, done = follow(start, advance, SMALLEST_PIECE)
    if done < 1.0 and anywhere:
        return _failure(at, (1.0 - done) * dq, w, tolerance, done, iterations)
    if iterations > most:
        return Sigma("out of reach", at, done, float("nan"), iterations, "that is too far away for one step")
    if done < 1.0:
        return _end_of_line(at, done, iterations)
    if at.margin() <= ROUNDING:
        return Sigma("singular", at, 1.0, 0.0, iterations, "phi_z is singular there")
    return Sigma("converged", at, 1.0, 0.0, iterations)


def _end_of_line(at: Kinematics, done: float, iterations: int) -> Sigma:
    miss = float("nan")  # not looked for
    if at.margin() <= 1e-3:
        return Sigma("singular", at, done, miss, iterations, "phi_z is singular on the way")
    return Sigma("out of reach", at, done, miss, iterations, "the loops cannot be kept closed on the way")


def _failure(at: Kinematics, dq: Array, w: Array | float, tolerance: float, done: float, iterations: int) -> Sigma:
    """Where the straight line ends, look at q itself: from z at its end, then from z anywhere.

    A q behind an unreachable region may still lie on this branch; known by the sign of det phi_z.
    """
    target = np.zeros(at.tree.n)
    target[at.partition.q] = dq
    tolerance *= at.tree.tolerance_factor(at.integrate(target).q_tree)
    start, random = at.integrate(target), np.random.default_rng(0)
    least, singular, other = np.inf, False, False
    for attempt in range(STARTS):
        spread = np.zeros(at.tree.n)
        spread[at.partition.z] = random.uniform(-np.pi, np.pi, len(at.partition.z)) if attempt else 0.0
        spread *= at.tree.step_scale
        nearest = _least_squares(start.integrate(spread), w, tolerance)
        miss = float(np.abs(nearest.phi - w).max(initial=0.0))
        least = min(least, miss)
        flat = nearest.margin() <= 1e-6
        if miss <= tolerance and not flat:
            if same_branch(at, nearest):
                return Sigma("converged", nearest, done, 0.0, iterations)
            other = True
        singular = singular or (flat and miss <= NEARLY * tolerance)
    if singular:
        return Sigma("singular", at, done, least, iterations, "phi_z is singular there")
    if other:
        reason = "the loops close there on another assembly branch only, behind a singular configuration"
    else:
        reason = f"the loops cannot close there (nearest miss {least:.3g})"
    return Sigma("out of reach", at, done, least, iterations, reason)


def _least_squares(at: Kinematics, w: Array | float, tolerance: float) -> Kinematics:
    """Levenberg-Marquardt on |phi - w| over z, q kept."""
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


BRANCH_STARTS = 400
LARGEST = 12  # dependent coordinates: beyond, random starts would miss most branches


def assembly_branches(mechanism: Mechanism) -> list[Kinematics]:
    """List the closed configurations at the assembled q, found from random z: the assembled one first.

    Raises
    ------
    InputError
        The mechanism is too large for random starts to tell anything.
    """
    at = mechanism.assembled
    z = mechanism.partition.z
    if len(z) > LARGEST or not mechanism.tree.is_euclidean:
        raise InputError(
            f"{mechanism.name}: branches are listed for mechanisms with at most {LARGEST} dependent joints; "
            f"this one has {len(z)}"
        )
    random = np.random.default_rng(0)
    reach = np.where(mechanism.tree.in_metres[z], mechanism.size, np.pi)
    found = [at]
    for _ in range(BRANCH_STARTS if len(z) else 0):
        step = np.zeros(mechanism.n)
        step[z] = random.uniform(-1.0, 1.0, len(z)) * reach
        closed = _settle(at.integrate(step), mechanism.tolerance)
        if closed is not None and all(_apart(mechanism, closed, other) for other in found):
            found.append(closed)
    return found


def _settle(start: Kinematics, tolerance: float) -> Kinematics | None:
    """Newton with steps cut to what is local."""
    at, z = start, start.partition.z
    for _ in range(60):
        outcome = newton(at, 0.0, tolerance)
        if outcome.converged:
            return outcome.at
        step = np.zeros(at.tree.n)
        step[z] = -np.linalg.lstsq(at.phi_z, at.phi, rcond=1e-6)[0]
        longest = np.abs(step).max()
        if not np.isfinite(longest) or longest == 0.0:
            return None
        at = at.integrate(step * min(1.0, 0.3 / longest))
    return None


def _apart(mechanism: Mechanism, a: Kinematics, b: Kinematics) -> bool:
    """Whether two configurations differ by more than whole turns."""
    gap: Array = a.q_tree - b.q_tree
    angles = ~mechanism.tree.in_metres
    gap[angles] = np.remainder(gap[angles] + np.pi, 2 * np.pi) - np.pi
    return bool(np.abs(gap).max() > 1e-6)
