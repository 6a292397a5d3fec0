"""The cost study: counts, choice of the tolerance, and budget."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate._ivp.bdf as bdf
import scipy.integrate._ivp.radau as radau

from ckc_pin.scene.scene import load_scene
from scripts.experiments.paper import cost_claims
from scripts.experiments.paper.cost import Cost, Search, cheapest, cost_at_equal_error, study
from scripts.experiments.paper.experiment import Outcome, Problem, difference, end_of, five_bar_problem, march, sample
from tests.conftest import assert_close

SWING = Path(__file__).parents[3] / "tests" / "regression" / "data" / "swing.json"
SHORT_S = 0.3


@pytest.fixture(scope="module")
def problem() -> Problem:
    return five_bar_problem(True)


# --- marching ----------------------------------------------------------------------------------------------------


def test_problem_of_scene_matches_reference_trajectory() -> None:
    data = json.loads(SWING.read_text())
    problem = Problem.of_scene(load_scene("five_bar/swing"))
    times = np.array([0.0, *data["t"]])
    states = sample(problem.dae(), "DOP853", 1e-12, times)
    assert_close([terms.q_tree for terms in states[1:]], data["q_tree"], 1e-9)
    assert_close([terms.q_dot for terms in states[1:]], np.array(data["v_tree"])[:, [0, 2]], 1e-9)


def test_problem_of_scene_has_its_controller() -> None:
    problem = Problem.of_scene(load_scene("five_bar/tracking"))
    a, b = (end_of(system, "Radau", 1e-7, 0.2) for system in (problem.reduced(), problem.printed_spf(1e-3)))
    free = Problem.free(problem.mechanism, problem.at, problem.q_dot)
    assert max(difference(a, b)) < 1e-6
    assert max(difference(a, end_of(free.reduced(), "Radau", 1e-7, 0.2))) > 0.1


@pytest.mark.parametrize(
    ("method", "module", "name"),
    [("BDF", bdf, "solve_bdf_system"), ("Radau", radau, "solve_collocation_system")],
)
def test_newton_iterations_are_recovered_from_nfev(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, method: str, module: Any, name: str
) -> None:
    counted, tried = 0, set[tuple[float, float]]()
    solve: Callable[..., Any] = getattr(module, name)

    def counting(fun: Any, t: float, y: Any, h: float, *args: Any) -> Any:
        nonlocal counted
        result = solve(fun, t, y, h, *args)
        counted += result[1]
        tried.add((t, h))
        return result

    monkeypatch.setattr(module, name, counting)
    outcome = march(problem.printed_spf(1e-3), method, 1e-5, SHORT_S)
    assert outcome.iterations is not None
    tolerance = (len(tried) - outcome.stats["steps"]) / 3 if method == "Radau" else 0
    assert counted <= outcome.iterations <= counted + tolerance
    assert counted > outcome.stats["steps"]


def test_explicit_methods_have_no_iterations_and_lsoda_none(problem: Problem) -> None:
    assert march(problem.reduced(), "DOP853", 1e-5, SHORT_S).iterations == 0
    assert march(problem.reduced(), "LSODA", 1e-5, SHORT_S).iterations is None


def test_only_the_reduced_model_solves_for_sigma(problem: Problem) -> None:
    assert march(problem.reduced(), "DOP853", 1e-6, SHORT_S).stats["newton"] > 0
    assert march(problem.printed_spf(1e-2), "DOP853", 1e-6, SHORT_S).stats["newton"] == 0


def test_explicit_right_hand_sides_grow_like_one_over_epsilon(problem: Problem) -> None:
    rhs = [march(problem.printed_spf(epsilon), "DOP853", 1e-5, SHORT_S).stats["rhs"] for epsilon in (1e-3, 1e-4)]
    assert 8 < rhs[1] / rhs[0] < 12


# --- equal error -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", [1e-3, 1e-6, 1e-10])
def test_loosest_tolerance_is_independent_of_first_tolerance(problem: Problem, first: float) -> None:
    search = Search(target=2e-8)
    reference = end_of(problem.dae(), "DOP853", 1e-12, SHORT_S)
    errors = [
        max(difference(reference, march(problem.reduced(), "DOP853", rtol, SHORT_S).terms)) for rtol in search.rtols
    ]
    reaching = [error <= search.target for error in errors]
    k = reaching.index(True)
    assert 0 < k < len(errors) - 1
    assert all(reaching[k:]), "a search from both sides needs one place where the target is crossed"
    cost = cost_at_equal_error(Cost("reduced", None, "DOP853"), problem.reduced, reference, SHORT_S, search, first)
    assert (cost.rtol, cost.error, cost.reason) == (search.rtols[k], errors[k], "")


def test_unreached_target_gives_reason(problem: Problem) -> None:
    reference = end_of(problem.dae(), "DOP853", 1e-12, SHORT_S)
    search = Search(rtols=(1e-3, 1e-4), target=1e-14)
    cost = cost_at_equal_error(Cost("reduced", None, "DOP853"), problem.reduced, reference, SHORT_S, search, 1e-3)
    assert cost.rtol == 1e-4
    assert cost.reason
    assert cost.error > search.target


def test_smaller_epsilons_are_skipped_after_budget_is_exhausted(problem: Problem) -> None:
    costs = study(problem, SHORT_S, (1e-2, 1e-4, 1e-5), ("DOP853",), Search(max_rhs=600))
    assert [(c.formulation, c.epsilon) for c in costs] == [
        ("reduced", None),
        ("DAE", None),
        ("eq. 8", 1e-2),
        ("eq. 8", 1e-4),
        ("eq. 8", 1e-5),
    ]
    done, stopped, untried = costs[2:]
    assert done.reason == ""
    assert done.error <= Search().target
    assert stopped.outcome is not None
    assert stopped.outcome.t < SHORT_S
    assert stopped.outcome.stats["rhs"] == 600
    assert stopped.reason
    assert untried.outcome is None
    assert untried.reason
    assert cheapest(costs, "eq. 8", 1e-2) is done


# --- the claim ---------------------------------------------------------------------------------------------------


def fake(problem: Problem, formulation: str, epsilon: float | None, seconds: float, newton: int) -> Cost:
    stats = {"rhs": 100, "steps": 10, "newton": newton, "factorizations": 200, "jacobians": 0}
    terms = problem.reduced().terms(0.0, problem.reduced().y0)
    return Cost(formulation, epsilon, "DOP853", 1e-6, 1e-7, Outcome(1.0, terms, stats, 0, seconds))


@pytest.mark.parametrize(
    ("seconds", "newton", "verdict"),
    [(0.5, 0, "holds"), (2.0, 0, "holds with a condition"), (0.5, 7, "does not hold")],
)
def test_verdict_depends_on_time_and_newton_iterations(
    problem: Problem, tmp_path: Path, seconds: float, newton: int, verdict: str
) -> None:
    stopped = replace(fake(problem, "eq. 8", 1e-5, 9.0, 0), reason="stopped at t = 1 s: the budget")
    costs = [
        fake(problem, "reduced", None, 1.0, 150),
        fake(problem, "DAE", None, 1.0, 3),
        fake(problem, "eq. 8", 1e-3, seconds, newton),
        fake(problem, "eq. 8", 1e-4, seconds, newton),
        stopped,
        Cost("eq. 8", 1e-6, "DOP853", reason="not tried"),
    ]
    claim = cost_claims.cost_claim(dict.fromkeys(cost_claims.SCENES, costs), tmp_path)
    assert claim.verdict == verdict
    assert claim.table is not None
    head, rows = claim.table
    assert len(rows) == 2 * len(costs)
    assert all(len(row) == len(head) for row in rows)
    assert [row[head.index("rhs")] for row in rows[:6]] == ["100", "100", "100", "100", "> 99", "not tried"]
    assert (tmp_path / claim.figures[0]).stat().st_size > 1000
