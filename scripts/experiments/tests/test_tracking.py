"""Tracking control's claims against closed forms and the five-bar of the appendix in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.scene.scene import load_scene
from scripts.experiments.paper import tracking
from scripts.experiments.paper.deviations import (
    PERIOD,
    FromLast,
    OwnSigma,
    Track,
    deviation,
    instants,
    track,
)
from scripts.experiments.paper.experiment import Problem
from scripts.experiments.paper.tracking_experiments import (
    EXACT,
    SCENE,
    SETTINGS,
    W0,
    lyapunov_along,
    off_manifold,
)
from scripts.experiments.paper.tracking_identities import (
    claimed_form,
    defect,
    printed_form,
    rate_form,
    skewness,
)
from tests.analysis.planar import linkage
from tests.analytic.five_bar import FIVE_BAR, Array, Q, Z, complex_step, desired
from tests.analytic.five_bar import tracking as numpy_tracking
from tests.conftest import Pair, assert_close

EPSILON = 1e-3
SHORT_RUN = {"t_end": 0.02, "solver.output_dt": 5e-5, "solver.method": "DOP853", "solver.rtol": 1e-10}


def errors(t: float, q_tree: Array, q_dot: Array) -> tuple[Array, Array]:
    q_d, q_d_dot, _ = desired(t)
    return q_tree[Q] - q_d, q_dot - q_d_dot


def numpy_V(t: float, q_tree: Array, q_dot: Array) -> float:
    """Return eq. 18 with eq. 22's gains and w = 0."""
    e, e_dot = errors(t, q_tree, q_dot)
    r = e_dot + e
    return float(r @ FIVE_BAR.D(q_tree) @ r / 2 + 10 * e @ e)


def on_w(q_tree: Array, w: Array) -> Array:
    """Return q_tree with z corrected by Newton to phi = w."""
    q_tree = q_tree.copy()
    for _ in range(20):
        q_tree[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree) - w)
    assert np.abs(FIVE_BAR.phi(q_tree) - w).max() < 1e-15
    return q_tree


def velocities(q_tree: Array, q_dot: Array, epsilon: float) -> tuple[Array, Array]:
    """Return the tree's velocity rho q_dot, and the velocity by eq. 8."""
    level = FIVE_BAR.rho(q_tree) @ q_dot
    actual = level.copy()
    actual[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree)) / epsilon
    return level, actual


def D_dot(q_tree: Array, v_tree: Array) -> Array:
    return FIVE_BAR.D(q_tree + 1e-200j * v_tree).imag / 1e-200


# --- eqs. 18 and 19 along runs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_lyapunov_function_and_rate_equal_numpy_five_bar(formulation: str) -> None:
    recorded = lyapunov_along({"formulation": formulation, **SHORT_RUN})
    assert recorded.mismatch < 1e-7
    assert recorded.monotone

    def rate(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], numpy_tracking(FIVE_BAR)(t, q_tree, y[2:]))])

    y0 = np.concatenate([FIVE_BAR.equilibrium()[Q], np.zeros(2)])
    y = solve_ivp(rate, (0, 0.02), y0, t_eval=recorded.t[::40], method="DOP853", rtol=1e-11, atol=1e-13).y.T
    states = [(t, FIVE_BAR.sigma(x[:2]), x[2:]) for t, x in zip(recorded.t[::40], y, strict=True)]
    assert_close(recorded.value[::40], [numpy_V(*state) for state in states], 1e-8)
    expected = [-10 * (e_dot @ e_dot + e @ e) for e, e_dot in (errors(*state) for state in states)]
    assert_close(recorded.predicted[::40], expected, 1e-8, relative=True)


def test_record_begins_at_since() -> None:
    complete, later = (lyapunov_along({"formulation": "reduced", **SHORT_RUN}, since) for since in (0.0, 0.01))
    assert len(later.t) == 201
    assert_close(later.t, complete.t[-201:], 0.0)
    assert_close(later.value, complete.value[-201:], 0.0)
    assert later.mismatch < 1e-7


@pytest.mark.parametrize("moving", [False, True])
def test_rate_error_with_rho_equals_nonskew_part(moving: bool) -> None:
    """With C at rho q_dot the error of dV/dt is r^T (D_dot - 2 C) r / 2, with D_dot along the actual velocity."""
    q_dot = np.array([1.0, -2.0]) if moving else np.zeros(2)
    q_tree = on_w(FIVE_BAR.equilibrium(), np.array(W0))
    e, e_dot = errors(0.0, q_tree, q_dot)
    level, actual = velocities(q_tree, q_dot, EPSILON)
    records = {name: off_manifold(EPSILON, name, moving) for name in ("rho", "actual")}
    assert records["actual"].mismatch < 1e-8
    assert records["rho"].mismatch > 1e-3
    for name, at in (("rho", level), ("actual", actual)):
        record, r = records[name], e + e_dot
        gap = r @ (D_dot(q_tree, actual) - 2 * FIVE_BAR.C(q_tree, at)) @ r / 2
        w = np.array(W0)
        assert_close(record.predicted[0], -10 * (e_dot @ e_dot + e @ e) - w @ w / EPSILON, 1e-10, relative=True)
        assert_close(record.rate[0] - record.predicted[0], gap, 1e-6)
        assert abs(gap) > 0.01 if name == "rho" else abs(gap) < 1e-10


def test_unsuitable_runs_raise() -> None:
    with pytest.raises(InputError, match="not a scene with tracking control"):
        lyapunov_along({}, scene="five_bar/swing")
    with pytest.raises(NumericalError, match="max_rhs"):
        lyapunov_along({**SHORT_RUN, "solver.max_rhs": 20})


# --- D_dot - 2 C -------------------------------------------------------------------------------------------------


def test_skewness_defect_equals_numpy_five_bar(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    random = np.random.default_rng(1)
    for _ in range(5):
        q_tree = FIVE_BAR.equilibrium() + random.uniform(-0.1, 0.1, 4)
        assert np.abs(FIVE_BAR.phi(q_tree)).max() > 1e-3
        level, actual = velocities(q_tree, random.uniform(-2, 2, 2), 1e-2)
        at = mechanism.kinematics(q_tree)
        for along, velocity, skew in ((level, level, True), (actual, actual, True), (actual, level, False)):
            rate = D_dot(q_tree, along)
            S = rate - 2 * FIVE_BAR.C(q_tree, velocity)
            expected = np.abs(S + S.T).max() / np.abs(rate).max()
            assert expected < 1e-13 if skew else expected > 0.1
            assert_close(defect(mechanism, at, along, velocity), expected, 1e-8 * max(1.0, expected))


def test_convention_matters_only_off_manifold(pair: Pair) -> None:
    skew = skewness(pair[0], 6, EPSILON)
    assert skew.states == 6
    assert max(skew.on, skew.off_rho_rho, skew.off_actual_actual) < 1e-9
    assert skew.off_actual_rho > 1.5


def test_skewness_with_more_freedoms() -> None:
    """Two chains of three links: n = 6, d = 4."""
    ring = linkage(
        [(0.0, [1.0, 1.0, 1.0]), (1.0, [1.0, 1.0, 1.0])], [2.2, -0.8, -0.7, 0.9, 0.8, 0.7], ["a1", "a2", "b1", "b2"]
    )
    skew = skewness(ring, 4, EPSILON)
    assert skew.states == 4
    assert max(skew.on, skew.off_rho_rho, skew.off_actual_actual) < 1e-8
    assert skew.off_actual_rho > 1.0


# --- the algebra of the gains ------------------------------------------------------------------------------------


@pytest.mark.parametrize("symmetric", [True, False])
def test_rate_form_equals_rate_of_linear_closed_loop(symmetric: bool) -> None:
    """D constant, C = 0: D r_dot = -K_D r, q_tilde_dot = r - Lambda q_tilde."""
    random = np.random.default_rng(2)
    D, K_D, S = (a @ a.T + np.eye(3) for a in random.standard_normal((3, 3, 3)))
    Lambda = np.linalg.solve(K_D, S) if symmetric else random.standard_normal((3, 3))

    def V(x: Array) -> Array:
        e, r = x[:3], x[3:]
        return np.array([r @ D @ r / 2 + e @ Lambda.T @ K_D @ e])

    for _ in range(5):
        e, e_dot = random.standard_normal((2, 3))
        r = e_dot + Lambda @ e
        (slope,) = complex_step(V, np.concatenate([e, r]))
        rate = slope @ np.concatenate([e_dot, -np.linalg.solve(D, K_D @ r)])
        x = np.concatenate([e, e_dot])
        assert_close(-x @ rate_form(Lambda, K_D) @ x, rate, 1e-12 * np.abs(rate_form(Lambda, K_D)).max())
        assert_close(x @ claimed_form(Lambda, K_D) @ x, e_dot @ K_D @ e_dot + e @ Lambda.T @ K_D @ Lambda @ e, 1e-11)
        assert_close(x @ printed_form(Lambda, K_D) @ x, r @ K_D @ r + 2 * e_dot @ Lambda @ K_D @ e, 1e-11)
    gap = np.abs(rate_form(Lambda, K_D) - claimed_form(Lambda, K_D)).max()
    assert gap < 1e-12 if symmetric else gap > 0.1


def test_accepted_gains_satisfy_gain_condition() -> None:
    K_D = np.array([[10.0, 3.0], [3.0, 5.0]])
    assert tracking.accepted(np.linalg.solve(K_D, np.diag([1.0, 2.0])), K_D)
    assert not tracking.accepted(np.diag([1.0, 3.0]), K_D)
    assert not tracking.accepted(-np.eye(2), K_D)


# --- deviations --------------------------------------------------------------------------------------------------


def test_periodic_and_irregular_deviations_are_distinguished() -> None:
    t, periods = instants(5), 5
    still = Track(np.zeros((len(t), 2)), 0.0)
    wave = np.column_stack([1e-3 * (2 + np.sin(t)), np.zeros_like(t)])
    periodic = deviation(Track(wave, 0.25), still)
    assert periodic.repeats > 0.999
    assert_close(periodic.period, PERIOD, 1e-12)
    assert_close(periodic.largest, 3e-3, 1e-6)
    assert periodic.open == 0.25
    other = deviation(Track(1e-3 * (2 + np.sin(1.5 * t[:, None])), 0.0), still)
    assert other.repeats < 0.6
    assert_close(other.period, PERIOD / 1.5, 1e-12)
    noise = np.random.default_rng(3).uniform(0, 1, (len(t), 2))
    assert_close(deviation(Track(noise, 0.0), still).repeats, 1 / (periods - 1), 0.1)
    only_at_first = np.where(t < PERIOD, 1.0, 1e-6 * (2 + np.sin(t)))[:, None]
    assert deviation(Track(only_at_first, 0.0), Track(np.zeros((len(t), 1)), 0.0)).largest < 1e-5


def own_sigma(tolerance: float) -> tuple[OwnSigma, Terms]:
    problem = Problem.of_scene(load_scene(SCENE))
    start = problem.mechanism.kinematics(FIVE_BAR.equilibrium())
    sigma = FromLast(problem.mechanism, start, tolerance)
    return OwnSigma(problem.force, sigma), Terms(problem.mechanism, start, np.zeros(4))


def test_controller_sigma_solves_z_within_tolerance() -> None:
    q_dot, q = np.array([1.0, -2.0]), FIVE_BAR.equilibrium()[Q] + [0.01, 0.005]
    moved = FIVE_BAR.sigma(q)
    stale = FIVE_BAR.equilibrium()
    stale[Q] = q
    assert 1e-3 < np.abs(FIVE_BAR.phi(stale)).max() < 1e-2
    for tolerance, z_from in ((1e-2, stale), (1e-12, moved)):
        controller, start = own_sigma(tolerance)
        assert_close(controller.sigma.accept_step(start.q).q_tree, FIVE_BAR.equilibrium(), 1e-12)
        at = start.mechanism.kinematics(moved)
        u_tree = controller(0.3, Terms(start.mechanism, at, at.rho @ q_dot))
        assert_close(u_tree[Q], numpy_tracking(FIVE_BAR)(0.3, z_from, q_dot), 1e-10)
        assert_close(u_tree[Z], 0.0, 0.0)
    right, wrong = (numpy_tracking(FIVE_BAR)(0.3, x, q_dot) for x in (moved, stale))
    assert np.abs(right - wrong).max() > 1e-3


def test_only_separate_loose_sigma_keeps_disturbing_q() -> None:
    times = np.linspace(0.0, 0.4, 9)
    exact, shared, separate = (
        track(SCENE, setting, times)
        for setting in (
            EXACT,
            replace(EXACT, rtol=1e-8, tolerance=1e-2),
            replace(EXACT, method="RK45", rtol=1e-3, controller_tolerance=1e-2),
        )
    )
    assert exact.open < 1e-12
    assert 1e-3 < shared.open <= 1e-2
    assert 1e-3 < separate.open <= 1e-2
    assert_close(exact.q[0], FIVE_BAR.equilibrium()[Q], 1e-10)
    # Plant and controller agree, so e_dot = -e for any z after r has decayed.
    felt, goes_on = ((x.q - exact.q)[1:] * np.exp(times[1:, None]) for x in (shared, separate))
    assert np.abs(felt).max() < 1e-4
    assert np.ptp(felt, axis=0).max() < 1e-7
    assert np.ptp(goes_on, axis=0).max() > 3e-4


def test_eq_8_and_reduced_model_track_like_numpy() -> None:
    times = np.linspace(0.0, 0.2, 5)

    def rate(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], numpy_tracking(FIVE_BAR)(t, q_tree, y[2:]))])

    y0 = np.concatenate([FIVE_BAR.equilibrium()[Q], np.zeros(2)])
    expected = solve_ivp(rate, (0.0, 0.2), y0, t_eval=times, method="Radau", rtol=1e-9, atol=1e-11).y[:2].T
    for setting in (EXACT, next(iter(SETTINGS["nothing"].values()))):
        assert_close(track(SCENE, setting, times).q, expected, 1e-7)
    with pytest.raises(InputError, match="a scene with a controller is needed"):
        track("five_bar/swing", EXACT, times)
