"""Errata of the controllers and their proofs: eqs. 14 to 19, each at a state of the five-bar that shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.ivp import LevelSet
from ckc_pin.simulation.prepare import scene_controller
from ckc_pin.simulation.scene import load_scene
from scripts.experiments.paper.erratum import Erratum
from scripts.experiments.paper.experiment import Problem, march
from scripts.experiments.paper.five_bar import FIVE_BAR

__all__ = ["CONTROL"]

Q_DOT = np.array([1.0, -2.0])  # rad/s
STEP = 1e-6  # s, of central differences
WEAK = 0.3  # N m/rad, a K_P too weak for eq. 15 to have one solution only
T = 1.0  # s, into the tracking run: the error is e^-1 of the initial one
ON_MANIFOLD = np.zeros(2)  # w, m


def set_point_error() -> Erratum:
    """Section II-B: which sign the error has."""
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
        where="eqs. 14 and 16 and the function of section II-B",
        printed="q_tilde has no definition where it is used first (eq. 14's brace says q_bar = q_d - q); eq. 16 "
        "defines q_tilde = q - q_d",
        correct="V = 1/2 q_dot^T D q_dot + V(q) + (q_d - q)^T h(q_d) + ...: with eq. 16's q_tilde that term has the "
        "wrong sign. The program has q - q_d everywhere and subtracts",
        difference=abs(wrong),
        agreement=abs(right),
        unit="W",
        measured="dV/dt + q_dot^T K_V q_dot of the closed loop at q_dot = (1, -2) rad/s, with eq. 16's error and with "
        "eq. 14's",
    )


def candidate_offset() -> Erratum:
    """Section II-B: the candidate is not zero at the target."""
    _, controller = _set_point()
    offset = controller.target.potential_energy
    at_target = controller.lyapunov(0.0, controller.target, ON_MANIFOLD)
    return Erratum(
        key="candidate-offset",
        where="section II-B, the function candidate",
        printed="V = 1/2 q_dot^T D q_dot + V(q) + q_tilde^T h(q_d) + 1/2 q_tilde^T K_P q_tilde, positive definite",
        correct="minus V(q_d): a positive definite function is zero at the equilibrium",
        difference=abs(float(offset)),
        agreement=abs(at_target),
        unit="J",
        measured="the candidate at q = q_d, q_dot = 0 (V(q) is zero with every centre of mass on the base line): as "
        "printed, and the one that the program reports",
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
        where="eq. 15",
        printed="h(q_d) - h(q) = K_P (q_d - q)",
        correct="h(q) - h(q_d) = K_P (q_d - q): eq. 14 at rest is u = h(q)",
        difference=float(np.abs(h_d - h - K_P @ (q_d - q)).max()),
        agreement=float(np.abs(h - h_d - K_P @ (q_d - q)).max()),
        unit="N m",
        measured="left minus right side at an equilibrium of the closed loop other than q_d, which "
        f"K_P = {WEAK} I is weak enough to leave: (theta_1, theta_3) = ({q[0]:.6f}, {q[1]:.6f})",
    )


def gain_condition() -> Erratum:
    """Eq. 18 needs a condition on Lambda^T K_D."""
    Lambda, K_D = np.array([[1.0, 4.0], [0.0, 1.0]]), np.eye(2)
    least = float(np.linalg.eigvalsh((Lambda.T @ K_D + K_D @ Lambda) / 2)[0])
    diagonal = float(np.linalg.eigvalsh(np.eye(2).T @ (10 * np.eye(2)))[0])
    return Erratum(
        key="gain-condition",
        where='eq. 18, "each positive definite since they are quadratic ... with constant, positive definite weights"',
        printed="no condition on Lambda and K_D together; d_1, d_2 > 0 not said either",
        correct="Lambda^T K_D symmetric positive definite: for the function to be positive, and for eq. 19's terms to "
        "cancel. The program refuses gains without it",
        difference=-least,
        agreement=max(0.0, -diagonal),
        unit="N m/rad",
        measured=f"how far below zero q_tilde^T Lambda^T K_D q_tilde goes on unit errors for "
        f"Lambda = {Lambda.tolist()}, K_D = I (both with positive eigenvalues only), and for eq. 22's gains",
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
        where="eq. 19, both lines",
        printed="... - 2 q_dot^T Lambda K_D q_tilde ... "
        "= -d1 q_dot^T K_D q_dot - d1 q_tilde^T Lambda^T K_D Lambda q_tilde - ...",
        correct="... + 2 q_tilde_dot^T K_D Lambda q_tilde ... = -d1 q_tilde_dot^T K_D q_tilde_dot - ...: rates of the "
        "error, and the sign that lets the terms cancel",
        difference=float(min(abs(first - truth), abs(last - truth))),
        agreement=float(abs(right - truth)),
        unit="W",
        measured=f"dV/dt by differences along the closed loop of `{FIVE_BAR}/tracking` at t = {T:g} s ({truth:.4f} W), "
        f"against the printed lines ({first:.4f} W and {last:.4f} W; the nearer one counts) and the correct one",
    )


def rate_on_trajectory() -> Erratum:
    """Eq. 19's last line, as printed, is negative where V is zero."""
    problem, controller = _tracking()
    q_d, q_d_dot, _ = controller.desired(T)
    found = sigma(problem.mechanism, q_d)
    reduced = replace(problem, at=found.at, q_dot=q_d_dot).reduced()
    measured = _rate(reduced, T, np.concatenate([q_d, q_d_dot]), _reported(reduced, controller))
    return Erratum(
        key="rate-on-trajectory",
        where='section II-C, "-V_dot is locally positive definite"',
        printed="-V_dot = d1 q_dot^T K_D q_dot + ...: not zero on the desired trajectory itself, where V is, so that V "
        "could not stay above zero",
        correct="positive definite in (q_tilde, q_tilde_dot, w), with the error's rate; in section II-B "
        "-V_dot = q_dot^T K_V q_dot is only semi-definite, which is why La Salle is needed",
        difference=abs(float(q_d_dot @ controller.K_D @ q_d_dot) + measured),
        agreement=abs(measured),
        unit="W",
        measured=f"with zero error on eq. 21 at t = {T:g} s: dV/dt by differences, which is zero, and its distance "
        "from the printed line",
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


def _scene(name: str) -> tuple[Problem, SetPoint | Tracking | None]:
    scene = load_scene(f"{FIVE_BAR}/{name}")
    problem = Problem.of_scene(scene)
    return problem, scene_controller(scene, problem.mechanism)


def _reported(reduced: LevelSet, controller: Tracking) -> Callable[[float, Array], float]:
    """Return the function that the program reports, of (t, y)."""
    return lambda t, y: controller.lyapunov(t, reduced.terms(t, y), ON_MANIFOLD)


def _rate(reduced: LevelSet, t: float, y: Array, V: Callable[[float, Array], float]) -> float:
    """Return dV/dt along the closed loop through y at t, by a central difference along its tangent."""
    y_dot = reduced.f(t, y)
    return (V(t + STEP, y + STEP * y_dot) - V(t - STEP, y - STEP * y_dot)) / (2 * STEP)
