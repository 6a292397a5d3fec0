"""Set-point control's claims against closed forms (pendulums) and the five-bar of the appendix in numpy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ckc_pin.errors import InputError
from ckc_pin.run.simulate import simulate
from scripts.experiments.certificate.certificate import Certificate
from scripts.experiments.certificate.gradient_bounds import chart_step, explore_branch, gradient_bounds
from scripts.experiments.paper import set_point
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.lyapunov import derivative, record
from scripts.experiments.paper.set_point_experiments import (
    DENSE,
    NEAR_START,
    SCENE,
    Case,
    along_run,
    equilibria_of,
    gradient_error,
    load_case,
)
from scripts.experiments.tests.set_point_cases import five_bar_gradient, five_bar_U
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import Pair, assert_close


def test_gradient_equals_differences_of_appendix_h(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    error, asymmetry, used = gradient_error(mechanism, 30)
    assert used > 15
    assert error < 1e-9
    assert asymmetry < 1e-14


# --- eq. 15 ------------------------------------------------------------------------------------------------------


def test_certified_case_has_one_equilibrium() -> None:
    case = load_case(NEAR_START)
    (only,) = equilibria_of(case, 10, 60)
    assert only.kind == "minimum"
    assert_close(only.q, case.controller.q_d, 1e-9)


def test_low_gains_have_further_equilibria_that_attract_runs() -> None:
    low = {"controller.K_P": 0.5}
    case = load_case(low)
    solutions = equilibria_of(case, 12, 60)
    q_d, h_d = case.controller.q_d, FIVE_BAR.h(FIVE_BAR.sigma(case.controller.q_d))
    for x in solutions:
        h = FIVE_BAR.h(FIVE_BAR.sigma(x.q))
        assert_close(h - h_d, 0.5 * (q_d - x.q), 1e-9)
        hessian = 0.5 * np.eye(2) + five_bar_gradient(x.q, 1e-4)
        assert (x.kind == "minimum") is bool(np.all(np.linalg.eigvalsh(hessian) > 0))
        assert_close(x.height, five_bar_U(case.controller, x.q), 1e-10)
    assert {x.kind for x in solutions} == {"minimum", "saddle"}
    run = simulate(SCENE, {**low, "t_end": 60.0})
    end = run.q_tree[-1, [0, 2]]
    assert np.abs(end - q_d).max() > 0.5
    assert min(np.abs(end - x.q).max() for x in solutions if x.kind == "minimum") < 1e-6


def test_scene_without_set_point_controller_is_rejected() -> None:
    with pytest.raises(InputError, match="set-point"):
        load_case(scene="five_bar/tracking")


# --- the Lyapunov function along runs ----------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_lyapunov_rate_equals_formula(formulation: str) -> None:
    run, recorded = along_run({**DENSE, "formulation": formulation, "t_end": 0.3, "solver.output_dt": 1e-3})
    assert recorded.monotone
    assert recorded.mismatch < 1e-6
    assert_close(recorded.value, [five_bar_V(run.q_tree[k], run.v_tree[k]) for k in range(len(run.t))], 1e-10)
    wrong = record(run, lambda k: 1.1 * float(recorded.predicted[k]))
    assert wrong.mismatch > 0.05
    rising = record(replace(run, lyapunov=recorded.value[::-1].copy()), lambda k: 1.0)
    assert not rising.monotone


def five_bar_V(q_tree: Array, v_tree: Array) -> float:
    q_d = np.full(2, np.pi / 4)
    at_d = FIVE_BAR.sigma(q_d)
    e = q_tree[[0, 2]] - q_d
    return float(
        FIVE_BAR.energy(q_tree, v_tree) - FIVE_BAR.potential_energy(at_d) - e @ FIVE_BAR.h(at_d) + 10 * e @ e / 2
    )


def test_spline_derivative_of_samples_is_accurate() -> None:
    t = np.linspace(0, 1, 101)
    assert_close(derivative(t, np.exp(-3 * t)), -3 * np.exp(-3 * t), 1e-9)


# --- the claims --------------------------------------------------------------------------------------------------


CHOSEN = ("equilibrium, K_P = 10 I", "(0.3, 0.5), K_P = 10 I", "equilibrium, K_P = 0.5 I")


@pytest.fixture(scope="module")
def certified() -> dict[str, tuple[Case, Certificate]]:
    cases = {name: load_case(set_point.ROWS[name]) for name in CHOSEN}
    return {name: (case, case.certificate(12)) for name, case in cases.items()}


def complete(claim: Claim, figures: Path) -> str:
    """Check that a claim's table and figures are complete, and return its verdict."""
    assert all((figures / name).stat().st_size > 5_000 for name in claim.figures)
    assert claim.table is not None
    assert all(len(row) == len(claim.table[0]) for row in claim.table[1])
    return claim.verdict


def test_gain_condition_verdict_follows_certificate(
    certified: dict[str, tuple[Case, Certificate]], tmp_path: Path
) -> None:
    case, certificate = certified[CHOSEN[0]]
    run, recorded = along_run({**DENSE, "formulation": "reduced", "t_end": 0.3})
    assert (
        complete(set_point.gain_claim(case, certificate, certified, run, tmp_path), tmp_path)
        == "holds with a condition"
    )
    assert complete(set_point.lyapunov_claim({"reduced": recorded}, tmp_path), tmp_path) == "holds"
    rising = record(replace(run, lyapunov=recorded.value[::-1].copy()), lambda k: 1.0)
    assert complete(set_point.lyapunov_claim({"reduced": rising}, tmp_path), tmp_path) == "does not hold"


def test_uniqueness_verdict_follows_solutions(certified: dict[str, tuple[Case, Certificate]], tmp_path: Path) -> None:
    solutions = {name: equilibria_of(case, 10, 30) for name, (case, _) in certified.items()}
    assert complete(set_point.uniqueness_claim(certified, solutions), tmp_path) == "holds"
    two = {**solutions, CHOSEN[1]: solutions[CHOSEN[1]] * 2}  # where the gain condition is certified
    assert complete(set_point.uniqueness_claim(certified, two), tmp_path) == "does not hold"


def test_bound_verdict_follows_growth(five_bar: Pair, tmp_path: Path) -> None:
    mechanism, case = five_bar[0], load_case()
    step = chart_step(mechanism, 16)
    explored = explore_branch(mechanism, mechanism.assembled, 16)
    rising = [gradient_bounds(mechanism, explored, [0.5, 0.1, 0.05], step)]
    right = (1e-11, 1e-15, 43)
    assert complete(set_point.gradient_claim(case, right, rising, tmp_path), tmp_path) == "holds with a condition"
    flat = [[replace(bound, norm=3.0) for bound in rising[0]]]
    assert complete(set_point.gradient_claim(case, right, flat, tmp_path), tmp_path) == "holds"
