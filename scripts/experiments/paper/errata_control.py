"""Errata of the controllers and their proofs, eqs. 14 to 19, each shown at a state of the five-bar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.run.ivp import LevelSet
from ckc_pin.scene.parts import build_scene_controller
from ckc_pin.scene.scene import load_scene
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.erratum import Erratum
from scripts.experiments.paper.experiment import Problem, march
from scripts.experiments.paper.five_bar import FIVE_BAR

__all__ = ["CONTROL"]

Q_DOT = np.array([1.0, -2.0])  # rad/s
STEP = 1e-6  # s, of central differences
WEAK = 0.3  # N m/rad: a K_P so small that eq. 15 has several solutions
T = 1.0  # s: time in the tracking run, at which the error is e^-1 of the initial one
ON_MANIFOLD = np.zeros(2)  # w, m


def set_point_error() -> Erratum:
    """Section II-B: the sign of the error."""
    reduced, controller = _set_point()
    state = np.concatenate([reduced.y0[: reduced.mechanism.d] + 0.3, Q_DOT])
    q_d, h_d = controller.q_d, controller.target.h

    def candidate(sign: float) -> Callable[[float, Array], float]:
        def value(t: float, y: Array) -> float:
            terms = reduced.terms(t, y)
            error = q_d - terms.q
            kinetic = 0.5 * terms.q_dot @ terms.D @ terms.q_dot
            return float(kinetic + terms.potential_energy + sign * error @ h_d + 0.5 * error @ controller.K_P @ error)

        return value

    expected = -Q_DOT @ controller.K_V @ Q_DOT
    right, wrong = (_rate(reduced, 0.0, state, candidate(sign)) - expected for sign in (1.0, -1.0))
    return Erratum(
        key="set-point-error",
        difference=abs(wrong),
        agreement=abs(right),
        unit="W",
        **render_blocks("errata/set-point-error"),
    )


def candidate_offset() -> Erratum:
    """Section II-B: the candidate is not zero at the target."""
    _, controller = _set_point()
    offset = controller.target.potential_energy
    at_target = controller.lyapunov(0.0, controller.target, ON_MANIFOLD)
    return Erratum(
        key="candidate-offset",
        difference=abs(float(offset)),
        agreement=abs(at_target),
        unit="J",
        **render_blocks("errata/candidate-offset"),
    )


def equilibrium_sign() -> Erratum:
    """Eq. 15: the sign of its right side."""
    mechanism = load(FIVE_BAR)
    _, controller = _set_point()
    q_d, h_d, K_P = controller.q_d, controller.target.h, WEAK * np.eye(2)
    at = mechanism.assembled
    for _ in range(50):
        q = mechanism.independent_part(at.q_tree)
        force = K_P @ (q_d - q) + h_d - Terms(mechanism, at, np.zeros(4)).h
        at = sigma(mechanism, q + np.linalg.solve(K_P + h_gradient(mechanism, at), force), at).at
    q = mechanism.independent_part(at.q_tree)
    h = Terms(mechanism, at, np.zeros(4)).h
    return Erratum(
        key="equilibrium-sign",
        difference=float(np.abs(h_d - h - K_P @ (q_d - q)).max()),
        agreement=float(np.abs(h - h_d - K_P @ (q_d - q)).max()),
        unit="N m",
        **render_blocks("errata/equilibrium-sign", gain=WEAK, q=q),
    )


def gain_condition() -> Erratum:
    """Eq. 18 needs a condition on Lambda^T K_D."""
    Lambda, K_D = np.array([[1.0, 4.0], [0.0, 1.0]]), np.eye(2)
    smallest = float(np.linalg.eigvalsh((Lambda.T @ K_D + K_D @ Lambda) / 2)[0])
    diagonal = float(np.linalg.eigvalsh(np.eye(2).T @ (10 * np.eye(2)))[0])
    return Erratum(
        key="gain-condition",
        difference=-smallest,
        agreement=max(0.0, -diagonal),
        unit="N m/rad",
        **render_blocks("errata/gain-condition", Lambda=Lambda.tolist()),
    )


def lyapunov_rate() -> Erratum:
    """Eq. 19: a sign, two tildes, an order."""
    problem, controller = _tracking()
    reduced = problem.reduced()
    reached = march(reduced, "Radau", 1e-10, T).terms
    q, q_dot, Lambda, K_D = reached.q, reached.q_dot, controller.Lambda, controller.K_D
    q_d, q_d_dot, _ = controller.desired(T)
    error, error_dot = q - q_d, q_dot - q_d_dot
    truth = _rate(reduced, T, np.concatenate([q, q_dot]), _reported(reduced, controller))
    r = error_dot + Lambda @ error
    first = -r @ K_D @ r - 2 * q_dot @ Lambda @ K_D @ error
    last = -q_dot @ K_D @ q_dot - error @ Lambda.T @ K_D @ Lambda @ error
    right = -error_dot @ K_D @ error_dot - error @ Lambda.T @ K_D @ Lambda @ error
    return Erratum(
        key="lyapunov-rate",
        difference=float(min(abs(first - truth), abs(last - truth))),
        agreement=float(abs(right - truth)),
        unit="W",
        **render_blocks("errata/lyapunov-rate", t=T, truth=truth, first=first, last=last),
    )


def rate_on_trajectory() -> Erratum:
    """Eq. 19's last line, as printed, is negative where V is zero."""
    problem, controller = _tracking()
    q_d, q_d_dot, _ = controller.desired(T)
    closed = sigma(problem.mechanism, q_d)
    reduced = replace(problem, at=closed.at, q_dot=q_d_dot).reduced()
    measured = _rate(reduced, T, np.concatenate([q_d, q_d_dot]), _reported(reduced, controller))
    return Erratum(
        key="rate-on-trajectory",
        difference=abs(float(q_d_dot @ controller.K_D @ q_d_dot) + measured),
        agreement=abs(measured),
        unit="W",
        **render_blocks("errata/rate-on-trajectory", t=T),
    )


CONTROL = (set_point_error, candidate_offset, equilibrium_sign, gain_condition, lyapunov_rate, rate_on_trajectory)


def _set_point() -> tuple[LevelSet, SetPoint]:
    """Return the reduced model under eq. 14, and its controller."""
    problem, controller = _scene("set_point")
    if not isinstance(controller, SetPoint):
        raise TypeError("five_bar/set_point has another controller")
    return problem.reduced(), controller


def _tracking() -> tuple[Problem, Tracking]:
    problem, controller = _scene("tracking")
    if not isinstance(controller, Tracking):
        raise TypeError("five_bar/tracking has another controller")
    return problem, controller


def _scene(name: str) -> tuple[Problem, object]:
    scene = load_scene(f"{FIVE_BAR}/{name}")
    problem = Problem.of_scene(scene)
    return problem, build_scene_controller(scene, problem.mechanism)


def _reported(reduced: LevelSet, controller: Tracking) -> Callable[[float, Array], float]:
    """Return the reported Lyapunov function as a function of (t, y)."""
    return lambda t, y: controller.lyapunov(t, reduced.terms(t, y), ON_MANIFOLD)


def _rate(reduced: LevelSet, t: float, y: Array, V: Callable[[float, Array], float]) -> float:
    """Return dV/dt along the closed loop through y at t, by a central difference along its tangent."""
    y_dot = reduced.f(t, y)
    return (V(t + STEP, y + STEP * y_dot) - V(t - STEP, y - STEP * y_dot)) / (2 * STEP)
