"""Whether a scene's controller is stable about its target, or along its desired motion; and which K_P would do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
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

FEWEST, MOST = 48, 768  # steps of the variational equation
AGREED = 0.05  # of the growth, between a number of steps and half as many: it is known four times as well
SURE = 1e-12  # of the fastest eigenvalue: what is no further left of the axis may be on it
NEWTON = 30  # iterations to where a controller with a model of its own comes to rest


@dataclass(frozen=True)
class Stability:
    """The closed loop about its target, linearized exactly.

    Attributes
    ----------
    stable : bool
    eigenvalues : (2 d,) complex array
        Of the closed loop at its target, 1/s, in falling order of real parts; of tracking at the start of the motion,
        where they say nothing about the rest of it.
    least_K_P : (d, d) array or None
        Of a set point: the least multiple of its K_P with K_P + dh/dq positive definite, from which on eq. 14 is
        stable; zero where it is without any.
    least_eigenvalue : float or None
        Of a set point: of K_P + dh/dq, N m/rad; the stiffness that is left in its weakest direction.
    slowest : float
        Time constant of the slowest decay, s: infinite where there is none. Of tracking, of the whole motion.
    growth, largest_growth : float or None
        Of tracking: by how much the variational equation multiplies an error of position that starts with e_dot = 0,
        the worst there is, until the end of the motion, and at most on the way.
    sampled : bool
        Whether the verdict, `slowest` and `growth` are those of the loop as it is sampled and delayed.
    multiplier : float or None
        Of a set point that is sampled: the largest factor of an error from one sample to the next, delay included.
    leaves_out : tuple of str
        What of the scene the linear model does not have: "sampling", "delay", "sensor and drive", "torque limits",
        "dry friction".
    """

    stable: bool
    eigenvalues: NDArray[np.complex128]
    least_K_P: Array | None
    least_eigenvalue: float | None
    slowest: float
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
) -> Stability | None:
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

    Returns
    -------
    Stability or None
        None where the target or the motion cannot be reached, or nothing comes to rest.
    """
    import scipy.linalg  # noqa: F401  (with its BLAS, before that is kept on one thread)

    with one_blas_thread():
        loop = ClosedLoop(mechanism, law, smoothing, library)
        if isinstance(law, SetPoint):
            return _about(mechanism, law, loop, sampling)
        return _along(mechanism, law, loop, t_end, sampling)


def _about(
    mechanism: Mechanism, law: SetPoint, closed_loop: ClosedLoop, sampling: tuple[float, float] | None
) -> Stability | None:
    at = _rest(mechanism, law)
    if at is None:
        return None
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


def _rest(mechanism: Mechanism, law: SetPoint) -> Kinematics | None:
    """Where the closed loop rests: its target, or near it where its model is another than the plant."""
    found = sigma(mechanism, law.q_d)
    for _ in range(NEWTON):
        if found.verdict != "converged":
            return None
        state = Terms(mechanism, found.at, np.zeros(mechanism.n))
        missing = law.u(0.0, state) - state.h
        if np.abs(missing).max() <= 1e-10 * (np.abs(law.target.h) + np.abs(law.K_P).max(axis=1)).max():
            return found.at
        step = np.linalg.lstsq(law.K_P + h_gradient(mechanism, found.at), missing, rcond=None)[0]
        found = sigma(mechanism, state.q + step, found.at)
    return None


def _time_constant(rate: float) -> float:
    return -1.0 / rate if rate < 0 else float("inf")


# --- along a motion ------------------------------------------------------------------------------


def _along(
    mechanism: Mechanism, law: Tracking, loop: ClosedLoop, t_end: float, sampling: tuple[float, float] | None
) -> Stability | None:
    linear = _linear_along(mechanism, law, loop)
    first = linear(0.0)
    if first is None:
        return None
    steps, reach = FEWEST, mechanism.tree.reach[mechanism.partition.q]
    while True:
        pieces = [linear((k + 0.5) * t_end / steps) for k in range(steps)]
        known = [x for x in pieces if x is not None and np.all(np.isfinite(x.closed))]
        if len(known) < steps:
            return None
        coarse = [one.mean(two) for one, two in zip(known[::2], known[1::2], strict=True)]
        grown, check = (_growth(x, t_end, reach, sampling) for x in (known, coarse))
        if not abs(grown[-1] - check[-1]) > AGREED * grown[-1] or 2 * steps > MOST:
            break
        steps *= 2
    return Stability(
        stable=bool(grown[-1] < 1.0),
        eigenvalues=eigenvalues_of(first.closed),
        least_K_P=None,
        least_eigenvalue=None,
        slowest=_time_constant(float(np.log(max(grown[-1], 1e-300))) / t_end),
        growth=float(grown[-1]),
        largest_growth=float(grown.max()),
        sampled=sampling is not None,
    )


def _linear_along(mechanism: Mechanism, law: Tracking, loop: ClosedLoop) -> Callable[[float], Feedback | None]:
    """Return the linear loop by time where the motion is as desired; None where it cannot be."""
    near = mechanism.assembled

    def linear(t: float) -> Feedback | None:
        nonlocal near
        q_d, q_d_dot, _ = law.desired(t)
        found = sigma(mechanism, q_d, near)
        if found.verdict != "converged":
            return None
        near = found.at
        return loop.at(t, Terms(mechanism, near, near.rho @ q_d_dot))

    return linear


def _growth(pieces: list[Feedback], t_end: float, reach: Array, sampling: tuple[float, float] | None) -> Array:
    """Growth of errors of position by time, from the variational equation, the loop constant in each piece.

    Infinite where it is no number any more.
    """
    from scipy.linalg import expm

    d, dt = len(reach), t_end / len(pieces)
    start = np.eye(2 * d)[:, :d] * reach
    with np.errstate(over="ignore", invalid="ignore"):
        if sampling is not None:
            states = sampled_motion(pieces, dt, start, *sampling)
        else:
            states = [start]
            for piece in pieces:
                states.append(expm(piece.closed * dt) @ states[-1])
    sizes = [state[:d] / reach[:, None] for state in states]
    return np.array([float(np.linalg.norm(x, 2)) if np.all(np.isfinite(x)) else np.inf for x in sizes])
