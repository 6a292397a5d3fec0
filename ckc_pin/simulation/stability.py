"""Whether a scene's controller is stable about its target, or along its desired motion; and which K_P would do."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.desired import cycles
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.formulations import tree_force
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.generated.library import Library
from ckc_pin.kinematics.continuation import follow
from ckc_pin.kinematics.sigma import move, sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.findings import beyond_stops
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.native import _core
from ckc_pin.simulation.closed_loop import ClosedLoop, Feedback
from ckc_pin.simulation.linear_model import eigenvalues_of
from ckc_pin.simulation.sampled_loop import MOST_DELAYED, MOST_SAMPLES, sampled_loop, sampled_motion

__all__ = ["Stability", "stability"]

FEWEST, MOST = 24, 8192  # steps of the variational equation
OF_A_CYCLE = 4  # steps of the quickest wave, where half as many are taken: all of them see it at different phases
AGREED = 0.02  # of the growth, between a number of steps and half as many: it is known four times as well
SURELY = 0.3  # of the growth's logarithm: where half as many steps are off by more, its sign is not known
NEAR = 0.1  # rad, or of the mechanism's size: what is linearized along the desired motion holds so far off it
BY_OFFSET = 5.0  # of the growth's logarithm, by that: it was 4 at most in a hundred random sampled loops
SURE = 1e-12  # of the fastest eigenvalue: what is no further left of the axis may be on it
NEWTON = 8  # iterations of a piece of the way to where a controller with another model's h comes to rest
SMALLEST_PIECE = 1e-4  # of that way
OFF = 1e-9  # rad, or of the mechanism's size: at its target
BALANCED = 1e-11  # of the forces: rounding
MISSED = 1e-9  # of what is wanted of the motors


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
        stable; zero where it is without any. None where it rests off its target, for where depends on K_P.
    least_eigenvalue : float or None
        Of a set point: of K_P + dh/dq, N m/rad; the stiffness that is left in its weakest direction.
    offset : (d,) array or None
        Of a set point where it rests, from its target, rad, m: not zero where what the controller compensates is
        another model's h. Of tracking how far the motion, started as desired, goes off the desired one at most, by
        sampling, delay, friction or another model.
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
        What of the scene the linear model does not have: "sensor and drive", "torque limits", "stops", "dry friction".
    """

    stable: bool | None
    reason: str | None = None
    eigenvalues: NDArray[np.complex128] | None = None
    least_K_P: Array | None = None
    least_eigenvalue: float | None = None
    offset: Array | None = None
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
    near: Kinematics | None = None,
    actuation: Actuation | None = None,
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
    near : Kinematics, optional
        Where a run starts: target and motion are meant on its assembly branch; default: as assembled.
    actuation : Actuation, optional
        Whose limits have to leave what holds the target, or the motion.
    """
    import scipy.linalg  # noqa: F401  (with its BLAS, before that is kept on one thread)

    with one_blas_thread():
        try:
            _require_countable(law, t_end, sampling)
            loop = _Loop(mechanism, law, ClosedLoop(mechanism, law, smoothing, library), smoothing, actuation)
            near = near or mechanism.assembled
            if isinstance(law, SetPoint):
                return _about(law, loop, near, sampling)
            return _along(law, loop, near, t_end, sampling)
        except NumericalError as error:
            return Stability(None, str(error))


def _require_countable(law: SetPoint | Tracking, t_end: float, sampling: tuple[float, float] | None) -> None:
    if sampling is None:
        return
    sample_time, delay = sampling
    if delay > MOST_DELAYED * sample_time:
        raise NumericalError(
            f"controller.delay lasts {delay / sample_time:.6g} samples; what is under way is followed for "
            f"{MOST_DELAYED} at most"
        )
    if isinstance(law, Tracking) and t_end > MOST_SAMPLES * sample_time:
        raise NumericalError(
            f"the motion has {t_end / sample_time:.6g} samples; at most {MOST_SAMPLES} are gone through: "
            "a shorter t_end has a verdict"
        )


@dataclass(frozen=True)
class _Loop:
    """A closed loop that is linearized where it can be."""

    mechanism: Mechanism
    law: SetPoint | Tracking
    closed_loop: ClosedLoop
    smoothing: float | None
    actuation: Actuation | None

    def at(self, t: float, state: Terms, where: str) -> Feedback:
        """Linearize it; NumericalError where a joint is beyond its stops or the motors do not give what is wanted."""
        if beyond := beyond_stops(self.mechanism, state.q_tree):
            raise NumericalError(f"{where} {beyond}")
        actuation = self.actuation
        if actuation is not None and np.isfinite(actuation.limit).any():
            wanted = self.law.u(t, state)
            given = actuation.apply(state, wanted)
            if np.abs(given.u - wanted).max() > MISSED * np.abs(wanted).max():
                tau = actuation.distribute(state.rho, wanted)
                k = int(np.argmax(np.abs(tau) / actuation.limit))
                raise NumericalError(
                    f"{where} {actuation.motors.names[k]} would need {abs(tau[k]):.4g}, its limit is "
                    f"{actuation.limit[k]:.4g}"
                )
        return self.closed_loop.at(t, state)

    def needed(self, state: Terms, q_ddot: Array) -> Array:
        """Return the u with which the mechanism moves on at an acceleration, dry friction left out if not smooth."""
        force = tree_force(state, state.rho @ q_ddot + state.rho_dot_times(state.q_dot))
        if self.smoothing is not None:
            force += self.mechanism.joints.friction * np.tanh(state.v_tree / self.smoothing)
        return state.rho.T @ force


# --- about a target ------------------------------------------------------------------------------


def _about(law: SetPoint, closed_loop: _Loop, near: Kinematics, sampling: tuple[float, float] | None) -> Stability:
    mechanism = closed_loop.mechanism
    target = sigma(mechanism, law.q_d, near)
    if target.verdict != "converged":
        raise NumericalError(f"the target is not reached from where the run starts: {target.reason}")
    if target.at.margin() <= _core.chart_margin:
        names = (", ".join(x) for x in (mechanism.independent, mechanism.dependent))
        raise NumericalError("the target is singular: {} do not determine {} there".format(*names))
    rest = Terms(mechanism, _rest(mechanism, law, target.at), np.zeros(mechanism.n))
    loop = closed_loop.at(0.0, rest, "where it would come to rest")
    values = eigenvalues_of(loop.closed)
    stable, slowest = bool(values[0].real < -SURE * np.abs(values).max()), _time_constant(float(values[0].real))
    multiplier = None
    if sampling is not None:
        multiplier = float(np.abs(np.linalg.eigvals(sampled_loop(loop, *sampling))).max())
        stable, slowest = multiplier < 1.0 - SURE, _time_constant(float(np.log(max(multiplier, 1e-300))) / sampling[0])
    reach = mechanism.tree.reach[mechanism.partition.q]
    K_P, hessian = (x / 2 + x.T / 2 for x in (law.K_P, h_gradient(mechanism, rest.at)))
    half, offset = np.linalg.inv(np.linalg.cholesky(K_P)), rest.q - law.q_d
    factor = max(0.0, -float(np.linalg.eigvalsh(half @ hessian @ half.T)[0]))
    return Stability(
        stable=stable,
        eigenvalues=values,
        least_K_P=factor * law.K_P if np.all(np.abs(offset) <= OFF * reach) else None,
        least_eigenvalue=float(np.linalg.eigvalsh(K_P + hessian)[0]),
        offset=offset,
        slowest=slowest,
        sampled=sampling is not None,
        multiplier=multiplier,
    )


def _rest(mechanism: Mechanism, law: SetPoint, target: Kinematics) -> Kinematics:
    """Where the closed loop rests: its target, or where that goes as h(q_d) becomes what the controller takes it for.

    The way from one to the other is followed, as long as K_P + dh/dq keeps its rank on it.
    """
    own = Terms(mechanism, target, np.zeros(mechanism.n)).h
    excess, scale = law.target.h - own, np.abs(own).max() + np.abs(law.K_P).max()
    if np.abs(excess).max() <= BALANCED * scale:
        return target

    def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
        sign = np.linalg.slogdet(law.K_P + h_gradient(mechanism, at))[0]
        for _ in range(NEWTON):
            state = Terms(mechanism, at, np.zeros(mechanism.n))
            missing = own + (done + part) * excess - law.K_P @ (state.q - law.q_d) - state.h
            stiffness = law.K_P + h_gradient(mechanism, at)
            if np.linalg.slogdet(stiffness)[0] != sign:
                return None
            if np.abs(missing).max() <= BALANCED * scale:
                return at
            step = np.asarray(np.linalg.solve(stiffness, missing), dtype=float)
            found = move(at, step, 0.0, mechanism.tolerance, anywhere=False)
            if found.verdict != "converged":
                return None
            at = found.at
        return None

    at, done = follow(target, advance, SMALLEST_PIECE)
    if done < 1.0:
        raise NumericalError(
            "what the controller takes for h(q_d) is so far from the plant's that the loop has no rest near its target"
        )
    return at


def _time_constant(rate: float) -> float:
    return -1.0 / rate if rate < 0 else float("inf")


# --- along a motion ------------------------------------------------------------------------------


def _along(
    law: Tracking, loop: _Loop, near: Kinematics, t_end: float, sampling: tuple[float, float] | None
) -> Stability:
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
    far = float((offset / loop.mechanism.tree.reach[loop.mechanism.partition.q]).max())
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
        slowest=_time_constant(end / t_end),
        growth=growth,
        largest_growth=largest_growth,
        sampled=sampling is not None,
    )


def _pieces(
    law: Tracking, loop: _Loop, near: Kinematics, t_end: float, steps: int
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
