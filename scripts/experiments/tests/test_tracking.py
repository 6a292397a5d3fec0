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
SHORT = {"t_end": 0.02, "solver.output_dt": 5e-5, "solver.method": "DOP853", "solver.rtol": 1e-10}


def errors(t: float, q_tree: Array, q_dot: Array) -> tuple[Array, Array]:
    q_d, q_d_dot, _ = desired(t)
    return q_tree[Q] - q_d, q_dot - q_d_dot


def numpy_V(t: float, q_tree: Array, q_dot: Array) -> float:
    """Eq. 18 with eq. 22's gains, w = 0."""
    e, e_dot = errors(t, q_tree, q_dot)
    r = e_dot + e
    return float(r @ FIVE_BAR.D(q_tree) @ r / 2 + 10 * e @ e)


def on_w(q_tree: Array, w: Array) -> Array:
    """z corrected by Newton until phi = w."""
    q_tree = q_tree.copy()
    for _ in range(20):
        q_tree[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree) - w)
    assert np.abs(FIVE_BAR.phi(q_tree) - w).max() < 1e-15
    return q_tree


def velocities(q_tree: Array, q_dot: Array, epsilon: float) -> tuple[Array, Array]:
    """The tree's velocity rho q_dot, and the one that eq. 8 gives it."""
    level = FIVE_BAR.rho(q_tree) @ q_dot
    actual = level.copy()
    actual[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree)) / epsilon
    return level, actual


def D_dot(q_tree: Array, v_tree: Array) -> Array:
    return FIVE_BAR.D(q_tree + 1e-200j * v_tree).imag / 1e-200


# --- eqs. 18 and 19 along runs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_function_and_rate_are_those_of_the_numpy_five_bar(formulation: str) -> None:
    found = lyapunov_along({"formulation": formulation, **SHORT})
    assert found.mismatch < 1e-7
    assert found.monotone

    def rate(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], numpy_tracking(FIVE_BAR)(t, q_tree, y[2:]))])

    y0 = np.concatenate([FIVE_BAR.equilibrium()[Q], np.zeros(2)])
    y = solve_ivp(rate, (0, 0.02), y0, t_eval=found.t[::40], method="DOP853", rtol=1e-11, atol=1e-13).y.T
    states = [(t, FIVE_BAR.sigma(x[:2]), x[2:]) for t, x in zip(found.t[::40], y, strict=True)]
    assert_close(found.value[::40], [numpy_V(*state) for state in states], 1e-8)
    expected = [-10 * (e_dot @ e_dot + e @ e) for e, e_dot in (errors(*state) for state in states)]
    assert_close(found.predicted[::40], expected, 1e-8, relative=True)


def test_record_begins_where_it_should() -> None:
    whole, later = (lyapunov_along({"formulation": "reduced", **SHORT}, since) for since in (0.0, 0.01))
    assert len(later.t) == 201
    assert_close(later.t, whole.t[-201:], 0.0)
    assert_close(later.value, whole.value[-201:], 0.0)
    assert later.mismatch < 1e-7


@pytest.mark.parametrize("moving", [False, True])
def test_rho_misses_eq_19_by_what_is_not_skew(moving: bool) -> None:
    """With C at rho q_dot dV/dt is off by r^T (D_dot - 2 C) r / 2, D_dot along the actual velocity."""
    q_dot = np.array([1.0, -2.0]) if moving else np.zeros(2)
    q_tree = on_w(FIVE_BAR.equilibrium(), np.array(W0))
    e, e_dot = errors(0.0, q_tree, q_dot)
    level, actual = velocities(q_tree, q_dot, EPSILON)
    found = {name: off_manifold(EPSILON, name, moving) for name in ("rho", "actual")}
    assert found["actual"].mismatch < 1e-8
    assert found["rho"].mismatch > 1e-3
    for name, at in (("rho", level), ("actual", actual)):
        record, r = found[name], e + e_dot
        gap = r @ (D_dot(q_tree, actual) - 2 * FIVE_BAR.C(q_tree, at)) @ r / 2
        w = np.array(W0)
        assert_close(record.predicted[0], -10 * (e_dot @ e_dot + e @ e) - w @ w / EPSILON, 1e-10, relative=True)
        assert_close(record.rate[0] - record.predicted[0], gap, 1e-6)
        assert abs(gap) > 0.01 if name == "rho" else abs(gap) < 1e-10


def test_runs_that_cannot_be_recorded_are_named() -> None:
    with pytest.raises(InputError, match="not a scene with tracking control"):
        lyapunov_along({}, scene="five_bar/swing")
    with pytest.raises(NumericalError, match="max_rhs"):
        lyapunov_along({**SHORT, "solver.max_rhs": 20})


# --- D_dot - 2 C -------------------------------------------------------------------------------------------------


def test_defect_is_the_numpy_five_bars(five_bar: Pair) -> None:
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


def test_convention_decides_off_the_closure_only(pair: Pair) -> None:
    found = skewness(pair[0], 6, EPSILON)
    assert found.states == 6
    assert max(found.on, found.off_rho_rho, found.off_actual_actual) < 1e-9
    assert found.off_actual_rho > 1.5


def test_more_freedoms_are_skew_alike() -> None:
    """Two chains of three links: n = 6, d = 4."""
    ring = linkage(
        [(0.0, [1.0, 1.0, 1.0]), (1.0, [1.0, 1.0, 1.0])], [2.2, -0.8, -0.7, 0.9, 0.8, 0.7], ["a1", "a2", "b1", "b2"]
    )
    found = skewness(ring, 4, EPSILON)
    assert found.states == 4
    assert max(found.on, found.off_rho_rho, found.off_actual_actual) < 1e-8
    assert found.off_actual_rho > 1.0


# --- the algebra of the gains ------------------------------------------------------------------------------------


@pytest.mark.parametrize("symmetric", [True, False])
def test_rate_form_is_the_rate_of_a_linear_closed_loop(symmetric: bool) -> None:
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


def test_gains_that_the_program_takes() -> None:
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


def test_a_controllers_own_sigma_keeps_its_z_within_the_tolerance() -> None:
    q_dot, q = np.array([1.0, -2.0]), FIVE_BAR.equilibrium()[Q] + [0.01, 0.005]
    moved = FIVE_BAR.sigma(q)
    stale = FIVE_BAR.equilibrium()
    stale[Q] = q
    assert 1e-3 < np.abs(FIVE_BAR.phi(stale)).max() < 1e-2
    for tolerance, z_from in ((1e-2, stale), (1e-12, moved)):
        controller, start = own_sigma(tolerance)
        assert_close(controller.sigma.keep(start.q).q_tree, FIVE_BAR.equilibrium(), 1e-12)
        at = start.mechanism.kinematics(moved)
        u_tree = controller(0.3, Terms(start.mechanism, at, at.rho @ q_dot))
        assert_close(u_tree[Q], numpy_tracking(FIVE_BAR)(0.3, z_from, q_dot), 1e-10)
        assert_close(u_tree[Z], 0.0, 0.0)
    right, wrong = (numpy_tracking(FIVE_BAR)(0.3, x, q_dot) for x in (moved, stale))
    assert np.abs(right - wrong).max() > 1e-3


def test_under_a_shared_loose_sigma_only_the_start_is_felt_in_q_and_the_controllers_own_goes_on_deviating() -> None:
    times = np.linspace(0.0, 0.4, 9)
    exact, shared, own = (
        track(SCENE, setting, times)
        for setting in (
            EXACT,
            replace(EXACT, rtol=1e-8, tolerance=1e-2),
            replace(EXACT, method="RK45", rtol=1e-3, own=1e-2),
        )
    )
    assert exact.open < 1e-12
    assert 1e-3 < shared.open <= 1e-2
    assert 1e-3 < own.open <= 1e-2
    assert_close(exact.q[0], FIVE_BAR.equilibrium()[Q], 1e-10)
    # plant and controller agree, so e_dot = -e once r has died out, whatever z is
    felt, goes_on = ((x.q - exact.q)[1:] * np.exp(times[1:, None]) for x in (shared, own))
    assert np.abs(felt).max() < 1e-4
    assert np.ptp(felt, axis=0).max() < 1e-7
    assert np.ptp(goes_on, axis=0).max() > 3e-4


def test_eq_8_and_the_reduced_model_track_like_numpy() -> None:
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
