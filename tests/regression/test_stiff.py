"""Stiff closed loops: choice of method, error along the run, and cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Run, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.native import _core
from scripts.experiments.stability.cases import GROUPS
from scripts.experiments.stability.cell import Variant, run_case
from tests.analytic.five_bar import FIVE_BAR, Array, Q, tracking


@pytest.fixture(scope="module")
def exact() -> Callable[[float], Array]:
    """(q, q_dot) of tracking with eq. 16 by the NumPy five-bar, accurate to about 1e-12."""
    u = tracking(FIVE_BAR)

    def rhs(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], u(t, q_tree, y[2:]))])

    start = np.concatenate([FIVE_BAR.equilibrium()[Q], np.zeros(2)])
    return solve_ivp(rhs, (0, 9.5), start, method="LSODA", rtol=1e-13, atol=1e-15, dense_output=True).sol


# rtol, largest number of right-hand sides
BUDGETS = {1e-4: 940, 1e-6: 950, 1e-8: 1_600, 1e-9: 1_850, 1e-10: 2_000}


@pytest.mark.parametrize("rtol", BUDGETS)
def test_error_along_tracking_is_within_tolerance(
    run: Callable[..., Run], exact: Callable[[float], Array], rtol: float
) -> None:
    ours = run("five_bar/tracking", formulation="spf", solver__rtol=rtol, solver__output_dt=0.01)
    assert ours.stats["method"] == "Radau"
    assert ours.stats["rhs"] <= BUDGETS[rtol]
    gap = np.abs(ours.q_tree[:, Q] - np.array([exact(t)[:2] for t in ours.t]))
    assert gap.max() <= 1.1 * rtol


@pytest.mark.parametrize(("rtol", "budget"), [(1e-6, 2_040), (1e-8, 2_940)])
def test_dae_error_along_tracking_is_within_tolerance(
    run: Callable[..., Run], exact: Callable[[float], Array], rtol: float, budget: int
) -> None:
    """The loops are closed at every output, although steps are not projected."""
    ours = run("five_bar/tracking", formulation="dae", solver__rtol=rtol, solver__output_dt=0.01)
    assert ours.stats["method"] == "Radau"
    assert ours.stats["rhs"] <= budget
    assert np.abs(ours.q_tree[:, Q] - np.array([exact(t)[:2] for t in ours.t])).max() <= 1.1 * rtol
    assert max(np.abs(FIVE_BAR.phi(q)).max() for q in ours.q_tree) <= 1e-12


def test_auto_detects_stiffness_during_the_run() -> None:
    """A damper becomes effective while a stretched spring still pushes, so modes grow at first."""
    case = next(case for case in GROUPS["spring"]() if case.name == "line 1e+06 N/m, damped")
    longer = {**case.overrides, "t_end": 0.4, "solver.output_dt": 0.1}
    auto, explicit = run_case(replace(case, overrides=longer, variants=(Variant("dae"), Variant("dae", "DOP853"))))
    assert (auto.method, auto.verdict, explicit.verdict) == ("auto: Radau", "within", "within")
    assert auto.rhs < 0.6 * explicit.rhs


def test_callers_controller_costs_as_many_right_hand_sides() -> None:
    """Its gradient is unknown, so the Jacobian is computed by finite differences."""
    overrides = {"formulation": "reduced", "t_end": 3.0}
    built_in = simulate("five_bar/set_point", overrides)

    class CustomController:
        def u(self, t: float, terms: Terms) -> Array:
            return terms.h - 10.0 * (terms.q - TARGET) - 10.0 * terms.q_dot

    callers = simulate("five_bar/set_point", overrides, controller=CustomController())
    assert built_in.status == callers.status == "done"
    assert built_in.stats["method"] == callers.stats["method"] == "Radau"
    assert callers.stats["rhs"] <= 1.2 * built_in.stats["rhs"]
    assert callers.stats["rhs"] <= callers.stats["python_calls"] <= callers.stats["rhs"] + len(callers.t) + 10


TARGET = FIVE_BAR.equilibrium()[Q] + [0.2, 0.1]


# modes in 1/s, end time in s
MODES = {
    "a slow oscillation": ([-0.1 + 3j, -0.1 - 3j], 10.0, False),
    "a fast oscillation, undamped": ([1e4j, -1e4j, 1j, -1j], 10.0, False),
    "one beside a decay as fast": ([1e4j, -1e4j, -1e4, -2e3], 10.0, False),
    "a fast decay beside a slow one": ([-600.0, -500.0, -1.0, -1.0], 9.5, True),
    "the same, over before it matters": ([-600.0, -500.0, -1.0, -1.0], 0.1, False),
    "a fast decay that rings": ([-300 + 900j, -300 - 900j, -1.0, -2.0], 10.0, True),
    "all decays at one rate, for long": ([-600.0, -600.0, -500.0, -500.0], 9.5, True),
    "growth": ([600.0, -600.0, 550.0, -550.0], 9.5, False),
}


@pytest.mark.parametrize("case", MODES)
def test_stiffness_detection_follows_the_modes(case: str) -> None:
    modes, t_end, stiff = MODES[case]
    random = np.random.default_rng(0)
    blocks = np.zeros((len(modes), len(modes)))
    k = 0
    while k < len(modes):
        mode = complex(modes[k])
        if mode.imag:
            blocks[k : k + 2, k : k + 2] = [[mode.real, mode.imag], [-mode.imag, mode.real]]
            k += 2
        else:
            blocks[k, k] = mode.real
            k += 1
    basis = random.normal(size=blocks.shape)
    assert _core.is_stiff(basis @ blocks @ np.linalg.inv(basis), t_end) == stiff
