"""Stability of closed loops: about the target of a set point, and along the desired motion of tracking."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.continuation import follow
from ckc_pin.kinematics.sigma import follow_sigma, sigma
from ckc_pin.linear.closed_loop import ClosedLoop, LimitedClosedLoop
from ckc_pin.linear.modes import compute_eigenvalues
from ckc_pin.linear.sampled_loop import MAX_DELAY_SAMPLES, MAX_MOTION_SAMPLES, build_sampled_loop
from ckc_pin.linear.stability_result import Stability, compute_time_constant
from ckc_pin.linear.tracking_stability import tracking_stability
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core

__all__ = ["stability"]

STABILITY_MARGIN = 1e-12  # relative to the fastest eigenvalue, or of a multiplier's distance from 1
MAX_NEWTON_ITERATIONS = 8  # in each continuation step towards the position of rest
MIN_CONTINUATION_STEP = 1e-4  # fraction of the way to the position of rest
OFFSET_TOLERANCE = 1e-9  # rad, or relative to the mechanism's size
FORCE_TOLERANCE = 1e-11  # relative to h and K_P at the target


def stability(
    mechanism: Mechanism,
    law: SetPoint | Tracking,
    t_end: float,
    *,
    smoothing: float | None = None,
    sampling: tuple[float, float] | None = None,
    library: Library | None = None,
    start: Kinematics | None = None,
    actuation: Actuation | None = None,
) -> Stability:
    """Return the stability of a controller's closed loop by linearization.

    Parameters
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
    t_end : float
        Duration of the desired motion, s.
    smoothing : float, optional
        The scene's friction_smoothing.
    sampling : (sample_time, delay), optional
        s; gives the stability of the sampled loop.
    library : Library, optional
        Compiled terms of the mechanism.
    start : Kinematics, optional
        Start of a run, which selects the assembly branch of target and motion. Default: the assembled configuration.
    actuation : Actuation, optional
        Motors whose limits must permit the torques at the target or along the motion.
    """
    with one_blas_thread(with_scipy=True):
        try:
            _require_sample_count(law, t_end, sampling)
            closed_loop = ClosedLoop(mechanism, law, smoothing, library)
            loop = LimitedClosedLoop(mechanism, law, closed_loop, smoothing, actuation)
            start = start or mechanism.assembled
            if isinstance(law, SetPoint):
                return _set_point_stability(law, loop, start, sampling)
            return tracking_stability(law, loop, start, t_end, sampling)
        except NumericalError as error:
            return Stability(None, str(error))


def _require_sample_count(law: SetPoint | Tracking, t_end: float, sampling: tuple[float, float] | None) -> None:
    """Raise NumericalError if the delay or the motion has too many samples."""
    if sampling is None:
        return
    sample_time, delay = sampling
    if delay > MAX_DELAY_SAMPLES * sample_time:
        raise NumericalError(
            f"controller.delay lasts {delay / sample_time:.6g} samples, but the sampled loop is computed for at most "
            f"{MAX_DELAY_SAMPLES} samples"
        )
    if isinstance(law, Tracking) and t_end > MAX_MOTION_SAMPLES * sample_time:
        raise NumericalError(
            f"the motion has {t_end / sample_time:.6g} samples, but errors are computed along at most "
            f"{MAX_MOTION_SAMPLES} samples; shorten t_end"
        )


def _set_point_stability(
    law: SetPoint, closed_loop: LimitedClosedLoop, start: Kinematics, sampling: tuple[float, float] | None
) -> Stability:
    """Linearize a set point's closed loop about its position of rest.

    Raises
    ------
    NumericalError
        The target is unreachable or singular, the loop has no position of rest near it, or it is not differentiable
        there.
    """
    mechanism = closed_loop.mechanism
    target = sigma(mechanism, law.q_d, start)
    if target.verdict != "converged":
        raise NumericalError(f"the target is not reached from the start of the run: {target.reason}")
    if target.at.margin() <= _core.chart_margin:
        names = (", ".join(x) for x in (mechanism.independent, mechanism.dependent))
        raise NumericalError("the target is singular: {} do not determine {} there".format(*names))
    rest = Terms(mechanism, _find_position_of_rest(mechanism, law, target.at), np.zeros(mechanism.n))
    loop = closed_loop.linearize(0.0, rest, "at the position of rest")
    values = compute_eigenvalues(loop.A_closed)
    stable = bool(values[0].real < -STABILITY_MARGIN * np.abs(values).max())
    slowest = compute_time_constant(float(values[0].real))
    multiplier = None
    if sampling is not None:
        multiplier = float(np.abs(np.linalg.eigvals(build_sampled_loop(loop, *sampling))).max())
        stable = multiplier < 1.0 - STABILITY_MARGIN
        slowest = compute_time_constant(float(np.log(max(multiplier, 1e-300))) / sampling[0])
    step_scale = mechanism.tree.step_scale[mechanism.partition.q]
    K_P, hessian = (x / 2 + x.T / 2 for x in (law.K_P, h_gradient(mechanism, rest.at)))
    inverse_root, offset = np.linalg.inv(np.linalg.cholesky(K_P)), rest.q - law.q_d
    factor = max(0.0, -float(np.linalg.eigvalsh(inverse_root @ hessian @ inverse_root.T)[0]))
    return Stability(
        stable=stable,
        eigenvalues=values,
        least_K_P=factor * law.K_P if np.all(np.abs(offset) <= OFFSET_TOLERANCE * step_scale) else None,
        least_eigenvalue=float(np.linalg.eigvalsh(K_P + hessian)[0]),
        offset=offset,
        slowest=slowest,
        sampled=sampling is not None,
        multiplier=multiplier,
    )


def _find_position_of_rest(mechanism: Mechanism, law: SetPoint, target: Kinematics) -> Kinematics:
    """Return the configuration in which a set point's closed loop comes to rest.

    It is the target if the controller compensates the plant's own h(q_d). Otherwise it is found by continuation from
    the plant's h(q_d) to the controller's, as long as K_P + dh/dq remains regular.

    Raises
    ------
    NumericalError
        K_P + dh/dq becomes singular on the way.
    """
    h_target = Terms(mechanism, target, np.zeros(mechanism.n)).h
    excess, scale = law.target.h - h_target, np.abs(h_target).max() + np.abs(law.K_P).max()
    if np.abs(excess).max() <= FORCE_TOLERANCE * scale:
        return target

    def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
        sign = np.linalg.slogdet(law.K_P + h_gradient(mechanism, at))[0]
        for _ in range(MAX_NEWTON_ITERATIONS):
            state = Terms(mechanism, at, np.zeros(mechanism.n))
            residual = h_target + (done + part) * excess - law.K_P @ (state.q - law.q_d) - state.h
            stiffness = law.K_P + h_gradient(mechanism, at)
            if np.linalg.slogdet(stiffness)[0] != sign:
                return None
            if np.abs(residual).max() <= FORCE_TOLERANCE * scale:
                return at
            step = np.asarray(np.linalg.solve(stiffness, residual), dtype=float)
            solution = follow_sigma(at, step, 0.0, mechanism.tolerance, anywhere=False)
            if solution.verdict != "converged":
                return None
            at = solution.at
        return None

    at, done = follow(target, advance, MIN_CONTINUATION_STEP)
    if done < 1.0:
        raise NumericalError(
            "the h(q_d) of the controller's model differs so much from the mechanism's that the loop has no position "
            "of rest near its target"
        )
    return at
