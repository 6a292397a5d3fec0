"""Whether a scene's controller is stable about its target, or along its desired motion; and which K_P would do."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.desired import cycles
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.generated.library import Library
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.closed_loop import ClosedLoop, Feedback
from ckc_pin.simulation.linear_model import eigenvalues_of
from ckc_pin.simulation.sampled_loop import sampled_loop, sampled_motion

__all__ = ["Stability", "stability"]

FEWEST, MOST = 24, 8192  # steps of the variational equation
OF_A_CYCLE = 4  # steps of the quickest wave, where half as many are taken: all of them see it at different phases
AGREED = 0.02  # of the growth, between a number of steps and half as many: it is known four times as well
SURELY = 0.3  # of the growth's logarithm: where half as many steps are off by more, its sign is not known
SURE = 1e-12  # of the fastest eigenvalue: what is no further left of the axis may be on it
NEWTON = 30  # iterations to where a controller with a model of its own comes to rest


@dataclass(frozen=True)
class Stability:
    """The closed loop about its target, linearized exactly.

    Attributes
    ----------
    stable : bool or None
        None where it is not known; what is not known besides is None too.
    reason : str or None
        Why not.
    eigenvalues : (2 d,) complex array or None
        Of the closed loop at its target, 1/s, in falling order of real parts; of tracking at the start of the motion,
        where they say nothing about the rest of it.
    least_K_P : (d, d) array or None
        Of a set point: the least multiple of its K_P with K_P + dh/dq positive definite, from which on eq. 14 is
        stable; zero where it is without any.
    least_eigenvalue : float or None
        Of a set point: of K_P + dh/dq, N m/rad; the stiffness that is left in its weakest direction.
    slowest : float or None
        Time constant of the slowest decay, s: infinite where there is none. Of tracking, of the whole motion.
    growth, largest_growth : float or None
        Of tracking: by how much the variational equation multiplies the worst error of state until the end of the
        motion, and at most on the way, measured by the root of eq. 18's function.
    sampled : bool
        Whether the verdict, `slowest` and `growth` are those of the loop as it is sampled and delayed.
    multiplier : float or None
        Of a set point that is sampled: the largest factor of an error from one sample to the next, delay included.
    leaves_out : tuple of str
        What of the scene the linear model does not have: "sensor and drive", "torque limits", "dry friction".
    """

    stable: bool | None
    reason: str | None = None
    eigenvalues: NDArray[np.complex128] | None = None
    least_K_P: Array | None = None
    least_eigenvalue: float | None = None
    slowest: float | None = None
    growth: float | None = None
    largest_growth: float | None = None
    sampled: bool = False
    multiplier: float | None = None
    leaves_out: tuple[str, ...] = ()


def stability(
    mechanism: Mechanism,
    law: SetPoint | Tracking,
    t_end: float,
    smoothing: float | None = None,
    sampling: tuple[float, float] | None = None,
    library: Library | None = None,
) -> Stability:
    """Linearize a controller's closed loop.

    Parameters
    ----------
    t_end : float
        How long a desired motion lasts, s.
    smoothing : float, optional
        A scene's friction_smoothing.
    sampling : (sample_time, delay), optional
        s; the verdict is then that of the sampled loop.
    library : Library, optional
        The mechanism's terms, compiled.
    """
    import scipy.linalg  # noqa: F401  (with its BLAS, before that is kept on one thread)

    with one_blas_thread():
        try:
            loop = ClosedLoop(mechanism, law, smoothing, library)
            if isinstance(law, SetPoint):
                return _about(mechanism, law, loop, sampling)
            return _along(mechanism, law, loop, t_end, sampling)
        except NumericalError as error:
            return Stability(None, str(error))


def _about(
    mechanism: Mechanism, law: SetPoint, closed_loop: ClosedLoop, sampling: tuple[float, float] | None
) -> Stability:
    at = _rest(mechanism, law)
    loop = closed_loop.at(0.0, Terms(mechanism, at, np.zeros(mechanism.n)))
    values = eigenvalues_of(loop.closed)
    stable, slowest = bool(values[0].real < -SURE * np.abs(values).max()), _time_constant(float(values[0].real))
    multiplier = None
    if sampling is not None:
        multiplier = float(np.abs(np.linalg.eigvals(sampled_loop(loop, *sampling))).max())
        stable, slowest = multiplier < 1.0, _time_constant(float(np.log(max(multiplier, 1e-300))) / sampling[0])
    K_P, hessian = (x / 2 + x.T / 2 for x in (law.K_P, h_gradient(mechanism, at)))
    half = np.linalg.inv(np.linalg.cholesky(K_P))
    factor = max(0.0, -float(np.linalg.eigvalsh(half @ hessian @ half.T)[0]))
    return Stability(
        stable=stable,
        eigenvalues=values,
        least_K_P=factor * law.K_P,
        least_eigenvalue=float(np.linalg.eigvalsh(K_P + hessian)[0]),
        slowest=slowest,
        sampled=sampling is not None,
        multiplier=multiplier,
    )


def _rest(mechanism: Mechanism, law: SetPoint) -> Kinematics:
    """Where the closed loop rests: its target, or near it where its model is another than the plant."""
    found = sigma(mechanism, law.q_d)
    for _ in range(NEWTON):
        if found.verdict != "converged":
            break
        state = Terms(mechanism, found.at, np.zeros(mechanism.n))
        missing = law.u(0.0, state) - state.h
        if np.abs(missing).max() <= 1e-10 * (np.abs(law.target.h) + np.abs(law.K_P).max(axis=1)).max():
            return found.at
        step = np.linalg.lstsq(law.K_P + h_gradient(mechanism, found.at), missing, rcond=None)[0]
        found = sigma(mechanism, state.q + step, found.at)
    raise NumericalError("where it comes to rest is not found")


def _time_constant(rate: float) -> float:
    return -1.0 / rate if rate < 0 else float("inf")


# --- along a motion ------------------------------------------------------------------------------


def _along(
    mechanism: Mechanism, law: Tracking, loop: ClosedLoop, t_end: float, sampling: tuple[float, float] | None
) -> Stability:
    turns = cycles(law.desired, t_end)
    if 2 * OF_A_CYCLE * turns > MOST:
        most = MOST / (2 * OF_A_CYCLE * turns) * t_end
        raise NumericalError(f"the desired motion is too quick to be followed for longer than {most:.3g} s")
    steps, end = max(FEWEST, int(np.ceil(OF_A_CYCLE * turns))), np.nan
    while True:
        before, grown = end, _growth(*_pieces(mechanism, law, loop, t_end, steps), t_end, sampling)
        end = float(grown[-1])
        off = 0.0 if end == before else abs(end - before)  # both may be infinite
        if off <= AGREED * max(1.0, abs(end)) or 2 * steps > MOST:
            break
        steps *= 2
    known = off < SURELY * abs(end)
    with np.errstate(over="ignore"):
        growth, largest_growth = (float(np.exp(x)) for x in (end, grown.max()))
    return Stability(
        stable=end < 0 if known else None,
        eigenvalues=eigenvalues_of(loop.at(0.0, _desired_state(mechanism, law, 0.0, mechanism.assembled)).closed),
        slowest=_time_constant(end / t_end),
        growth=growth,
        largest_growth=largest_growth,
        sampled=sampling is not None,
        reason=None if known else f"errors change by {growth:.3g} times, which is not known well enough to tell from 1",
    )


def _pieces(
    mechanism: Mechanism, law: Tracking, loop: ClosedLoop, t_end: float, steps: int
) -> tuple[list[Feedback], list[Array]]:
    """Return the linear loop in the middle of each step, and the root of eq. 18's matrix from step to step."""
    at, pieces, inertias = mechanism.assembled, [], []
    middles = (np.arange(steps) + 0.5) * t_end / steps
    for t in (0.0, *middles, t_end):
        state = _desired_state(mechanism, law, float(t), at)
        at = state.at
        inertias.append(state.D)
        if 0.0 < t < t_end:
            pieces.append(loop.at(float(t), state))
    between = [(one + two) / 2 for one, two in pairwise(inertias[1:-1])]
    return pieces, [_metric(law, D) for D in (inertias[0], *between, inertias[-1])]


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
    with np.errstate(over="ignore", invalid="ignore"):
        states = _motion(pieces, dt, start) if sampling is None else sampled_motion(pieces, dt, start, *sampling)
        sizes = [(metric @ state, log) for metric, (state, log) in zip(metrics, states, strict=True)]
    return np.array([log + np.log(np.linalg.norm(x, 2)) if np.all(np.isfinite(x)) else np.inf for x, log in sizes])


def _motion(pieces: list[Feedback], dt: float, start: Array) -> list[tuple[Array, float]]:
    """Return what states become without sampling, as `sampled_motion` does."""
    from scipy.linalg import expm

    found = [(start, 0.0)]
    for piece in pieces:
        x, log = found[-1]
        x = expm(piece.closed * dt) @ x
        size = max(float(np.abs(x).max()), 1e-300)
        found.append((x / size, log + float(np.log(size))))
    return found
