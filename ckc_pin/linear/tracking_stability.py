"""Stability of tracking along its desired motion: growth of errors by the variational equation of the closed loop."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import Tracking
from ckc_pin.control.desired import count_cycles, find_rate_jump
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import Feedback, LimitedClosedLoop
from ckc_pin.linear.modes import compute_eigenvalues
from ckc_pin.linear.sampled_loop import propagate_sampled_loop
from ckc_pin.linear.stability_result import Stability, compute_time_constant
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["tracking_stability"]

MIN_STEPS, MAX_STEPS = 24, 8192  # of the variational equation
STEPS_PER_CYCLE = 4  # in the first attempt; further steps see the fastest wave at other phases
GROWTH_TOLERANCE = 0.02  # of the logarithm of the growth, between a number of steps and half of it
MAX_GROWTH_ERROR = 0.3  # relative to the logarithm of the growth; beyond this its sign is uncertain
MAX_OFFSET = 0.1  # rad, or relative to the mechanism's size; the linearization is valid so far from the desired motion
GROWTH_ERROR_PER_OFFSET = 5.0  # of the logarithm of the growth; it was 4 at most in a hundred random sampled loops


def tracking_stability(
    law: Tracking, loop: LimitedClosedLoop, start: Kinematics, t_end: float, sampling: tuple[float, float] | None
) -> Stability:
    """Linearize tracking's closed loop along its desired motion.

    The number of steps of the variational equation is doubled until the growth converges.

    Parameters
    ----------
    law : Tracking
    loop : LimitedClosedLoop
    start : Kinematics
        A configuration on the assembly branch of the motion.
    t_end : float
        Duration of the motion, s.
    sampling : (sample_time, delay) or None
        s.

    Raises
    ------
    NumericalError
        The motion is too fast or leaves the workspace, its rate jumps, or the loop cannot be linearized along it.
    """
    jump = find_rate_jump(law.desired, t_end)
    if jump is not None:
        raise NumericalError(
            f"the desired rate jumps at t = {jump:.6g} s, where a run deviates from the desired motion"
        )
    cycle_count = count_cycles(law.desired, t_end)
    if 2 * STEPS_PER_CYCLE * cycle_count > MAX_STEPS:
        longest = MAX_STEPS / (2 * STEPS_PER_CYCLE * cycle_count) * t_end
        raise NumericalError(f"the desired motion is too fast to be analyzed for longer than {longest:.3g} s")
    steps, end = max(MIN_STEPS, int(np.ceil(STEPS_PER_CYCLE * cycle_count))), np.nan
    while True:
        previous_end, (pieces, driven, metrics) = end, _linearize_along(law, loop, start, t_end, steps)
        log_growth = _compute_log_growth(pieces, metrics, t_end, sampling)
        end = float(log_growth[-1])
        error = 0.0 if end == previous_end else abs(end - previous_end)  # both may be infinite
        if error <= GROWTH_TOLERANCE * max(1.0, abs(end)) or 2 * steps > MAX_STEPS:
            break
        steps *= 2
    offset = _compute_offset(driven, t_end, sampling)
    relative_offset = float((offset / loop.mechanism.tree.step_scale[loop.mechanism.partition.q]).max())
    with np.errstate(over="ignore"):
        growth, largest_growth = (float(np.exp(x)) for x in (end, log_growth.max()))
    offset_error = GROWTH_ERROR_PER_OFFSET * min(relative_offset, MAX_OFFSET) * max(1.0, abs(end))
    reason = None
    if not error < MAX_GROWTH_ERROR * abs(end):
        reason = f"errors change by a factor of {growth:.3g}, which is too uncertain to tell growth from decay"
    elif (end < 0 and relative_offset > MAX_OFFSET) or not offset_error < abs(end):
        reason = (
            f"errors change by a factor of {growth:.3g} along the desired motion, but a run deviates from it by up to "
            f"{relative_offset:.2g} rad or sizes, because of sampling, delay, friction or the controller's model"
        )
    first = loop.linearize(0.0, _compute_desired_state(loop.mechanism, law, 0.0, start), "at t = 0")
    return Stability(
        stable=end < 0 if reason is None else None,
        reason=reason,
        eigenvalues=compute_eigenvalues(first.A_closed),
        offset=offset,
        slowest=compute_time_constant(end / t_end),
        growth=growth,
        largest_growth=largest_growth,
        sampled=sampling is not None,
    )


def _linearize_along(
    law: Tracking, loop: LimitedClosedLoop, start: Kinematics, t_end: float, steps: int
) -> tuple[list[Feedback], list[Feedback], list[Array]]:
    """Linearize the loop in the middle of each step.

    Returns
    -------
    list of Feedback
        Of errors.
    list of Feedback
        The same with a constant input, see `_add_constant_input`.
    list of (2 d, 2 d) arrays
        Square roots of the matrix of eq. 18's function, at both ends of all steps.
    """
    at, pieces, driven, inertias = start, [], [], []
    middles = (np.arange(steps) + 0.5) * t_end / steps
    for t in (0.0, *middles.tolist(), t_end):
        state = _compute_desired_state(loop.mechanism, law, t, at)
        at = state.at
        inertias.append(state.D)
        if 0.0 < t < t_end:
            piece = loop.linearize(t, state, f"at t = {t:.5g} s of the desired motion")
            required_u = loop.compute_required_u(state, law.desired(t)[2])
            pieces.append(piece)
            driven.append(_add_constant_input(piece, law.u(t, state), required_u))
    between = [(one + two) / 2 for one, two in pairwise(inertias[1:-1])]
    return pieces, driven, [_compute_metric(law, D) for D in (inertias[0], *between, inertias[-1])]


def _add_constant_input(piece: Feedback, u: Array, required_u: Array) -> Feedback:
    """Add a state that is 1, which applies the controller's u on the desired motion minus the u that it requires."""
    states, d = piece.B.shape
    A = np.block([[piece.A, -(piece.B @ required_u)[:, None]], [np.zeros((1, states + 1))]])
    return Feedback(A, np.vstack([piece.B, np.zeros((1, d))]), np.hstack([piece.K, u[:, None]]))


def _compute_offset(driven: list[Feedback], t_end: float, sampling: tuple[float, float] | None) -> Array:
    """Return the largest error of a motion that starts on the desired one, by coordinate."""
    states, d = driven[0].B.shape
    start = np.eye(states)[:, -1:]
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        errors = [x[:d, 0] / x[-1, 0] for x, _ in _propagate(driven, t_end / len(driven), start, sampling)]
    return np.nan_to_num(np.abs(errors), nan=np.inf, posinf=np.inf).max(axis=0)


def _compute_desired_state(mechanism: Mechanism, law: Tracking, t: float, guess: Kinematics) -> Terms:
    """Return the state of the desired motion, on the assembly branch of the initial guess."""
    q_d, q_d_dot, _ = law.desired(t)
    solution = sigma(mechanism, q_d, guess)
    if solution.verdict != "converged":
        raise NumericalError(f"the desired motion cannot be followed at t = {t:.5g} s: {solution.reason}")
    return Terms(mechanism, solution.at, solution.at.rho @ q_d_dot)


def _compute_metric(law: Tracking, D: Array) -> Array:
    """Return R such that |R x|^2 is eq. 18's function of x = (e, e_dot), which decreases along eq. 16's closed loop."""
    root, root_of_e = (np.linalg.cholesky(x / 2 + x.T / 2).T for x in (D / 2, law.Lambda.T @ law.K_D))
    return np.block([[root_of_e, np.zeros_like(root)], [root @ law.Lambda, root]])


def _compute_log_growth(
    pieces: list[Feedback], metrics: list[Array], t_end: float, sampling: tuple[float, float] | None
) -> Array:
    """Return the logarithm of the growth of errors at the ends of all steps; infinite where it overflows."""
    dt, start = t_end / len(pieces), np.asarray(np.linalg.inv(metrics[0]), dtype=float)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        states = _propagate(pieces, dt, start, sampling)
        sizes = [(metric @ state, log) for metric, (state, log) in zip(metrics, states, strict=True)]
        return np.array([log + np.log(np.linalg.norm(x, 2)) if np.all(np.isfinite(x)) else np.inf for x, log in sizes])


def _propagate(
    pieces: list[Feedback], dt: float, start: Array, sampling: tuple[float, float] | None
) -> list[tuple[Array, float]]:
    """Propagate states with or without sampling; returns those of `propagate_sampled_loop`."""
    from scipy.linalg import expm

    if sampling is not None:
        return propagate_sampled_loop(pieces, dt, start, *sampling)
    states = [(start, 0.0)]
    for piece in pieces:
        x, log = states[-1]
        x = expm(piece.A_closed * dt) @ x
        size = max(float(np.abs(x).max()), 1e-300)
        states.append((x / size, log + float(np.log(size))))
    return states
