"""The study of epsilon against the appendix's five-bar in numpy, with integrations of eqs. 8 and 1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from scripts.experiments.paper import tikhonov
from scripts.experiments.paper.boundary_layer import (
    directions,
    eigenvalues_around,
    eq_13,
    measured_layer,
    problem_after_layer,
    solve_eq_12,
)
from scripts.experiments.paper.consistent_start import measure
from scripts.experiments.paper.experiment import W0, Problem, five_bar_problem, on_level
from scripts.experiments.paper.tikhonov import Convergence, converge
from tests.analytic.five_bar import FIVE_BAR, Array, Q, Z, complex_step
from tests.conftest import Pair, assert_close

STARTS = {"rest": False, "moving": True}
Q_DOT = {"rest": np.zeros(2), "moving": np.array([1.0, -2.0])}


@pytest.fixture(scope="module")
def problems() -> dict[str, Problem]:
    return {name: five_bar_problem(moving) for name, moving in STARTS.items()}


# --- the numpy five-bar -------------------------------------------------------------------------


def start() -> Array:
    return FIVE_BAR.sigma(FIVE_BAR.equilibrium()[Q] + 0.5)


def on_w(q_tree: Array, w: Array) -> Array:
    """Return q_tree with z corrected by Newton to phi = w."""
    q_tree = q_tree.copy()
    for _ in range(20):
        q_tree[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree) - w)
    assert np.abs(FIVE_BAR.phi(q_tree) - w).max() < 1e-15
    return q_tree


def spf_end(q_dot: Array, epsilon: float, convention: str) -> Array:
    """Return (q', q_dot) at t = 1 by eq. 8 as printed, integrated in (q', q_dot)."""

    def rate(t: float, y: Array) -> Array:
        q_tree, q_dot = y[:4], y[4:]
        v_rho = FIVE_BAR.rho(q_tree) @ q_dot
        v_tree = v_rho.copy()
        v_tree[Z] -= np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree)) / epsilon
        C = FIVE_BAR.C(q_tree, v_rho if convention == "rho" else v_tree)
        q_ddot = np.linalg.solve(FIVE_BAR.D(q_tree), -C @ q_dot - FIVE_BAR.h(q_tree))
        return np.concatenate([v_tree, q_ddot])

    y0 = np.concatenate([on_w(start(), W0), q_dot])
    return solve_ivp(rate, (0.0, 1.0), y0, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]


def dae_end(q_dot: Array) -> Array:
    """Return (q', q_dot) at t = 1 by eq. 1 with multipliers."""

    def rate(t: float, y: Array) -> Array:
        q_tree, v_tree = y[:4], y[4:]
        return np.concatenate([v_tree, FIVE_BAR.acceleration_and_multipliers(q_tree, v_tree, np.zeros(2))[0]])

    y0 = np.concatenate([start(), FIVE_BAR.rho(start()) @ q_dot])
    end = solve_ivp(rate, (0.0, 1.0), y0, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.concatenate([end[:4], end[4:][Q]])


@pytest.mark.parametrize("convention", ["rho", "actual"])
@pytest.mark.parametrize("name", STARTS)
def test_difference_equals_numpy_five_bar(problems: dict[str, Problem], name: str, convention: str) -> None:
    off = spf_end(Q_DOT[name], 1e-2, convention) - dae_end(Q_DOT[name])
    study = converge(problems[name], W0, (1e-2,), convention)  # type: ignore[arg-type]
    assert_close(study.x[0], np.abs(off[[*Q, 4, 5]]).max(), 2e-9)
    assert_close(study.z[0], np.abs(off[Z]).max(), 2e-9)


def test_numpy_and_package_have_equal_starts(problems: dict[str, Problem]) -> None:
    problem = problems["moving"]
    assert_close(problem.at.q_tree, start(), 1e-12)
    assert_close(on_level(problem.mechanism, problem.at, W0).q_tree, on_w(start(), W0), 1e-12)


# --- the order ---------------------------------------------------------------------------------------------------

# Measured with the numpy five-bar before this study was written (two or three digits).
NUMPY_DIFFERENCES = {"rest": {1e-4: 9.12e-5, 1e-5: 9.12e-6}, "moving": {1e-4: 1.83e-5, 1e-5: 1.77e-6}}


@pytest.mark.parametrize("name", STARTS)
def test_order_is_one_with_rho(problems: dict[str, Problem], name: str) -> None:
    study = converge(problems[name], W0, (1e-4, 1e-5, 1e-6))
    assert study.resolved
    assert_close(study.z_orders, [1.0, 1.0], 0.05)
    assert_close(study.orders, [1.0, 1.0], 0.05)
    for epsilon, x in NUMPY_DIFFERENCES[name].items():
        assert_close(study.x[study.epsilons == epsilon], x, 0.005, relative=True)


def test_actual_velocity_converges_from_rest_and_not_from_a_moving_start(problems: dict[str, Problem]) -> None:
    rest = converge(problems["rest"], W0, (1e-4, 1e-6), "actual")
    assert rest.resolved
    assert_close(rest.orders, [1.0], 0.05)
    moving = converge(problems["moving"], W0, (1e-5, 1e-6), "actual")
    assert_close(moving.x, [7.00e-2, 7.00e-2], 5e-5)


def test_actual_velocity_approaches_the_dae_behind_the_layer(problems: dict[str, Problem]) -> None:
    moving = problems["moving"]
    behind = problem_after_layer(moving, W0)
    study = converge(moving, W0, (1e-5, 1e-6), "actual", reference=behind)
    assert_close(study.orders, [1.0], 0.05)


def test_layer_changes_q_dot_as_in_numpy_and_conserves_energy(problems: dict[str, Problem]) -> None:
    """The numpy integration is in (z, q_dot) by fast time, without the package's level sets."""

    def rate(tau: float, y: Array) -> Array:
        q_tree = start()
        q_tree[Z] = y[:2]
        v_tree = np.zeros(4)
        v_tree[Z] = -np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree))
        q_ddot = -np.linalg.solve(FIVE_BAR.D(q_tree), FIVE_BAR.C(q_tree, v_tree) @ y[2:])
        return np.concatenate([v_tree[Z], q_ddot])

    off = on_w(start(), W0)
    y0 = np.concatenate([off[Z], Q_DOT["moving"]])
    end = solve_ivp(rate, (0.0, 40.0), y0, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
    behind = problem_after_layer(problems["moving"], W0).q_dot
    assert_close(behind, end[2:], 1e-10)
    assert np.abs(behind - Q_DOT["moving"]).max() > 1e-2
    before = Q_DOT["moving"] @ FIVE_BAR.D(off) @ Q_DOT["moving"]
    assert_close(behind @ FIVE_BAR.D(start()) @ behind, before, 1e-10, relative=True)


# --- the boundary layer ------------------------------------------------------------------------------------------


def test_solution_of_eq_12_satisfies_differential_equation(problems: dict[str, Problem]) -> None:
    def rate(tau: float, z: Array) -> Array:
        q_tree = start()
        q_tree[Z] = z
        return -np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree))

    taus = np.array([0.0, 0.3, 1.0, 4.0])
    solved = solve_ivp(rate, (0.0, 4.0), on_w(start(), W0)[Z], t_eval=taus, method="DOP853", rtol=1e-12, atol=1e-14)
    problem = problems["rest"]
    assert_close(solve_eq_12(problem.mechanism, problem.at, W0, taus), solved.y.T - start()[Z], 1e-10)


def test_spf_layer_equals_eq_12_to_first_order(problems: dict[str, Problem]) -> None:
    layer = measured_layer(problems["moving"], W0, (1e-4, 1e-5), np.linspace(0.0, 10.0, 41))
    assert_close(layer.misses[0] / layer.misses[1], 10.0, 0.3)
    assert layer.factor < 1.1
    assert_close(layer.measured[:, 0], layer.y[0], 1e-12)


@pytest.mark.parametrize("w", [np.zeros(2), W0, np.array([-0.02, 0.03])])
def test_gradient_of_eq_13_equals_complex_step(five_bar: Pair, w: Array) -> None:
    def g(z: Array) -> Array:
        q_tree = off.q_tree.astype(complex)
        q_tree[Z] = z
        return -np.linalg.solve(FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi(q_tree))

    mechanism, _ = five_bar
    off = on_level(mechanism, mechanism.assembled, w)
    theirs = complex_step(g, off.q_tree[Z])
    assert_close(eq_13(off), theirs, 1e-11)
    if not np.any(w):
        assert_close(theirs, -np.eye(2), 1e-11)


def test_eigenvalues_are_nan_beyond_end_of_branch(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    values = eigenvalues_around(mechanism, mechanism.assembled, 0.01, 8)
    assert values.shape == (8, 2)
    assert np.all(values.real < 0)
    assert np.isnan(eigenvalues_around(mechanism, mechanism.assembled, 2.0, 8)).all()


@pytest.mark.parametrize("rows", [2, 3, 6])
def test_directions_are_unit_vectors(rows: int) -> None:
    vectors = directions(rows, 12)
    assert vectors.shape == (12, rows)
    assert_close(np.linalg.norm(vectors, axis=1), 1.0, 1e-14)
    assert np.linalg.matrix_rank(vectors) == rows


# --- consistent starts -------------------------------------------------------------------------------------------


def test_epsilon_has_no_influence_from_consistent_start(problems: dict[str, Problem]) -> None:
    rtol = 1e-5
    study = measure(problems["moving"], rtol, (1e-1, 1e-4, 1e-8), (1e-1, 1e-12), t_end=0.5)
    assert np.all(study.printed < 10 * rtol)
    assert np.all(study.printed < 10 * study.radau)
    assert np.all(study.eq_17 == study.dop853)


# --- verdicts ----------------------------------------------------------------------------------------------------


def convergence(order: float, unsure: float = 1e-3) -> Convergence:
    epsilons = np.array([1e-4, 1e-5, 1e-6])
    x = epsilons**order
    return Convergence(epsilons, x, x / 3, unsure * x, unsure * x)


@pytest.mark.parametrize(
    ("moving", "verdict"),
    [
        (convergence(1.0), "holds"),
        (convergence(1.04), "holds"),
        (convergence(0.9), "does not hold"),
        (convergence(1.0, unsure=0.2), "does not hold"),
    ],
)
def test_order_verdict_follows_orders(moving: Convergence, verdict: str) -> None:
    claim = tikhonov.order_claim(convergence(1.0), moving, "start", "figure.png")
    assert claim.verdict == verdict
    assert claim.table is not None
    assert float(claim.table[1][2][1]) == pytest.approx(1e-6)


def test_velocity_verdict_follows_numbers(problems: dict[str, Problem]) -> None:
    problem = problems["moving"]
    flat = replace(convergence(1.0), x=np.full(3, 0.07))
    claim = tikhonov.velocity_claim(convergence(1.0), flat, convergence(1.0), problem, problem, "figure.png")
    assert claim.verdict == "does not hold"
