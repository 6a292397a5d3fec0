"""Whether tracking is stable along its desired motion: how errors grow by the variational equation of the loop."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import Tracking
from ckc_pin.control.desired import cycles
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import Feedback
from ckc_pin.linear.limited_closed_loop import LoopWithinLimits
from ckc_pin.linear.linear_model import eigenvalues_of
from ckc_pin.linear.sampled_loop import sampled_motion
from ckc_pin.linear.stability_result import Stability, time_constant
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["tracking_stability"]

FEWEST, MOST = 24, 8192  # steps of the variational equation
OF_A_CYCLE = 4  # steps of the quickest wave, where half as many are taken: all of them see it at different phases
AGREED = 0.02  # of the growth, between a number of steps and half as many: it is known four times as well
SURELY = 0.3  # of the growth's logarithm: where half as many steps are off by more, its sign is not known
NEAR = 0.1  # rad, or of the mechanism's size: what is linearized along the desired motion holds so far off it
BY_OFFSET = 5.0  # of the growth's logarithm, by that: it was 4 at most in a hundred random sampled loops


def tracking_stability(
    law: Tracking, loop: LoopWithinLimits, near: Kinematics, t_end: float, sampling: tuple[float, float] | None
) -> Stability:
    """Linearize tracking's closed loop along its desired motion.

    Parameters
    ----------
    near : Kinematics
        The motion is meant on its assembly branch.
    t_end : float
        How long it lasts, s.
    sampling : (sample_time, delay) or None
        s.

    Raises
    ------
    NumericalError
        The motion is too quick, cannot be followed, or the loop cannot be linearized along it.
    """
    turns = cycles(law.desired, t_end)
    if 2 * OF_A_CYCLE * turns > MOST:
        most = MOST / (2 * OF_A_CYCLE * turns) * t_end
        raise NumericalError(f"the desired motion is too quick to be followed for longer than {most:.3g} s")
    steps, end = max(FEWEST, int(np.ceil(OF_A_CYCLE * turns))), np.nan
    while True:
        before, (pieces, driven, metrics) = end, _pieces(law, loop, near, t_end, steps)
        grown = _growth(pieces, metrics, t_end, sampling)
        end = float(grown[-1])
        off = 0.0 if end == before else abs(end - before)  # both may be infinite
        if off <= AGREED * max(1.0, abs(end)) or 2 * steps > MOST:
            break
        steps *= 2
    offset = _offset(driven, t_end, sampling)
    far = float((offset / loop.mechanism.tree.step_scale[loop.mechanism.partition.q]).max())
    with np.errstate(over="ignore"):
        growth, largest_growth = (float(np.exp(x)) for x in (end, grown.max()))
    reason = None
    if not off < SURELY * abs(end):
        reason = f"errors change by {growth:.3g} times, which is not known well enough to tell from 1"
    elif (end < 0 and far > NEAR) or not BY_OFFSET * min(far, NEAR) * max(1.0, abs(end)) < abs(end):
        reason = (
            f"errors change by {growth:.3g} times along the desired motion, but a run goes up to {far:.2g} rad or "
            "sizes off it, by sampling, delay, friction or its model"
        )
    return Stability(
        stable=end < 0 if reason is None else None,
        reason=reason,
        eigenvalues=eigenvalues_of(loop.at(0.0, _desired_state(loop.mechanism, law, 0.0, near), "at t = 0").closed),
        offset=offset,
        slowest=time_constant(end / t_end),
        growth=growth,
        largest_growth=largest_growth,
        sampled=sampling is not None,
    )


def _pieces(
    law: Tracking, loop: LoopWithinLimits, near: Kinematics, t_end: float, steps: int
) -> tuple[list[Feedback], list[Feedback], list[Array]]:
    """Return the linear loop in the middle of each step, of errors and driven, and the root of eq. 18's matrix by step.

    The driven one has a state more, which is 1: it also has the u that the controller gives on the desired motion, and
    lacks what this needs.
    """
    at, pieces, driven, inertias = near, [], [], []
    middles = (np.arange(steps) + 0.5) * t_end / steps
    for t in (0.0, *middles.tolist(), t_end):
        state = _desired_state(loop.mechanism, law, t, at)
        at = state.at
        inertias.append(state.D)
        if 0.0 < t < t_end:
            piece = loop.at(t, state, f"at t = {t:.5g} s of the desired motion")
            pieces.append(piece)
            driven.append(_driven(piece, law.u(t, state), loop.needed(state, law.desired(t)[2])))
    between = [(one + two) / 2 for one, two in pairwise(inertias[1:-1])]
    return pieces, driven, [_metric(law, D) for D in (inertias[0], *between, inertias[-1])]


def _driven(piece: Feedback, given: Array, needed: Array) -> Feedback:
    states, d = piece.B.shape
    A = np.block([[piece.A, -(piece.B @ needed)[:, None]], [np.zeros((1, states + 1))]])
    return Feedback(A, np.vstack([piece.B, np.zeros((1, d))]), np.hstack([piece.K, given[:, None]]))


def _offset(driven: list[Feedback], t_end: float, sampling: tuple[float, float] | None) -> Array:
    """Return how far a motion that starts as desired goes off what is desired, at most, by coordinate."""
    states, d = driven[0].B.shape
    start = np.eye(states)[:, -1:]
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        found = [x[:d, 0] / x[-1, 0] for x, _ in _states(driven, t_end / len(driven), start, sampling)]
    return np.nan_to_num(np.abs(found), nan=np.inf, posinf=np.inf).max(axis=0)


def _desired_state(mechanism: Mechanism, law: Tracking, t: float, near: Kinematics) -> Terms:
    """Where the motion is as desired, on the branch of what is near."""
    q_d, q_d_dot, _ = law.desired(t)
    found = sigma(mechanism, q_d, near)
    if found.verdict != "converged":
        raise NumericalError(f"the desired motion cannot be followed at t = {t:.5g} s: {found.reason}")
    return Terms(mechanism, found.at, found.at.rho @ q_d_dot)


def _metric(law: Tracking, D: Array) -> Array:
    """Return R with eq. 18's function |R x|^2 of x = (e, e_dot): it falls along eq. 16's own closed loop."""
    root, of_e = (np.linalg.cholesky(x / 2 + x.T / 2).T for x in (D / 2, law.Lambda.T @ law.K_D))
    return np.block([[of_e, np.zeros_like(root)], [root @ law.Lambda, root]])


def _growth(pieces: list[Feedback], metrics: list[Array], t_end: float, sampling: tuple[float, float] | None) -> Array:
    """Logarithm of the growth of errors by time, from the variational equation, the loop constant in each piece.

    Infinite where it is no number any more.
    """
    dt, start = t_end / len(pieces), np.asarray(np.linalg.inv(metrics[0]), dtype=float)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        states = _states(pieces, dt, start, sampling)
        sizes = [(metric @ state, log) for metric, (state, log) in zip(metrics, states, strict=True)]
        return np.array([log + np.log(np.linalg.norm(x, 2)) if np.all(np.isfinite(x)) else np.inf for x, log in sizes])


def _states(
    pieces: list[Feedback], dt: float, start: Array, sampling: tuple[float, float] | None
) -> list[tuple[Array, float]]:
    """Return what states become, as `sampled_motion` does, or without samples."""
    from scipy.linalg import expm

    if sampling is not None:
        return sampled_motion(pieces, dt, start, *sampling)
    found = [(start, 0.0)]
    for piece in pieces:
        x, log = found[-1]
        x = expm(piece.closed * dt) @ x
        size = max(float(np.abs(x).max()), 1e-300)
        found.append((x / size, log + float(np.log(size))))
    return found
