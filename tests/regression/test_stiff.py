"""Stiff closed loops: what `auto` takes, that the error along the whole run is the tolerance, and what that costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Run, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene
from ckc_pin.simulation.stiffness import choose
from ckc_pin.simulation.systems import Dae
from ckc_pin.study.stability.cases import GROUPS
from ckc_pin.study.stability.cell import How, run_case
from tests.analytic.five_bar import FIVE_BAR, Array, Q, tracking
from tests.conftest import assert_close


@pytest.fixture(scope="module")
def exact() -> Callable[[float], Array]:
    """(q, q_dot) of eq. 16's tracking by the numpy five-bar, to some 1e-12."""
    u = tracking(FIVE_BAR)

    def rhs(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], u(t, q_tree, y[2:]))])

    start = np.concatenate([FIVE_BAR.equilibrium()[Q], np.zeros(2)])
    return solve_ivp(rhs, (0, 9.5), start, method="LSODA", rtol=1e-13, atol=1e-15, dense_output=True).sol


# rtol, and the right-hand sides that it may take
BUDGETS = {1e-4: 520, 1e-6: 800, 1e-8: 1_700, 1e-9: 2_400, 1e-10: 3_600}


@pytest.mark.parametrize("rtol", BUDGETS)
def test_the_error_along_tracking_is_the_tolerance(
    run: Callable[..., Run], exact: Callable[[float], Array], rtol: float
) -> None:
    ours = run("five_bar/tracking", formulation="spf", solver__rtol=rtol, solver__output_dt=0.01)
    assert ours.stats["method"] == "BDF"
    assert ours.stats["rhs"] <= BUDGETS[rtol]
    gap = np.abs(ours.q_tree[:, Q] - np.array([exact(t)[:2] for t in ours.t]))
    assert gap.max() <= 1.1 * rtol


@pytest.mark.parametrize(("rtol", "budget"), [(1e-6, 1_600), (1e-8, 3_300)])
def test_the_dae_does_as_well(
    run: Callable[..., Run], exact: Callable[[float], Array], rtol: float, budget: int
) -> None:
    """On its closure at every output, though no step is edited."""
    ours = run("five_bar/tracking", formulation="dae", solver__rtol=rtol, solver__output_dt=0.01)
    assert ours.stats["method"] == "BDF"
    assert ours.stats["rhs"] <= budget
    assert np.abs(ours.q_tree[:, Q] - np.array([exact(t)[:2] for t in ours.t])).max() <= 1.1 * rtol
    assert max(np.abs(FIVE_BAR.phi(q)).max() for q in ours.q_tree) <= 1e-12


def test_the_jacobian_of_the_dae_is_that_of_its_right_hand_side() -> None:
    """In all directions, those across the freedoms included, against central differences."""
    system = prepare(load_scene("five_bar/tracking", {"formulation": "dae"})).system
    assert isinstance(system, Dae)
    system.close_within()
    q_tree = FIVE_BAR.sigma(FIVE_BAR.equilibrium()[Q] + [0.4, -0.3])
    y, h = np.concatenate([q_tree, FIVE_BAR.rho(q_tree) @ [1.0, -2.0]]), 1e-6
    found = system.jacobian(0.3, y, system.rhs)
    steps = h * np.eye(8)
    slopes = [(system.rhs(0.3, y + step) - system.rhs(0.3, y - step)) / (2 * h) for step in steps]
    assert_close(found, np.transpose(slopes), 1e-6, relative=True)
    assert np.sum(np.abs(np.linalg.eigvals(found)) < 1e-3) == system.held == 4


def test_what_becomes_stiff_on_the_way_is_noticed() -> None:
    """A damper that grips while the spring beside it, stretched at the start, still pushes: at first modes grow."""
    case = next(case for case in GROUPS["spring"]() if case.name == "line 1e+06 N/m, damped")
    longer = {**case.changes, "t_end": 0.4, "solver.output_dt": 0.1}
    auto, explicit = run_case(replace(case, changes=longer, how=(How("dae"), How("dae", "DOP853"))))
    assert (auto.method, auto.verdict, explicit.verdict) == ("auto: BDF", "within", "within")
    assert auto.rhs < 0.6 * explicit.rhs


def test_a_controller_that_knows_no_gradient_costs_no_more() -> None:
    """d u / d q_dot by differences of u alone: as many right-hand sides as with eq. 14's own, within a tenth."""
    changes = {"formulation": "reduced", "t_end": 3.0}
    known = simulate("five_bar/set_point", changes)

    class Plain:
        def u(self, t: float, terms: Terms) -> Array:
            return -10.0 * (terms.q - TARGET) - 10.0 * terms.q_dot

    class Told(Plain):
        def u_rate_gradient(self, t: float, terms: Terms) -> Array:
            return -10.0 * np.eye(2)

    plain, told = (simulate("five_bar/set_point", changes, controller=kind()) for kind in (Plain, Told))
    assert known.status == plain.status == told.status == "done"
    assert plain.stats["method"] == told.stats["method"] == "BDF"
    assert plain.stats["rhs"] <= 1.1 * told.stats["rhs"]
    assert_close(plain.q_tree, told.q_tree, 1e-7)


TARGET = FIVE_BAR.equilibrium()[Q] + [0.2, 0.1]


# modes in 1/s and the end in s
MODES = {
    "a slow oscillation": ([-0.1 + 3j, -0.1 - 3j], 10.0, "DOP853"),
    "a fast oscillation, undamped": ([1e4j, -1e4j, 1j, -1j], 10.0, "DOP853"),
    "a fast decay beside a slow one": ([-600.0, -500.0, -1.0, -1.0], 9.5, "BDF"),
    "the same, over before it matters": ([-600.0, -500.0, -1.0, -1.0], 0.1, "DOP853"),
    "a fast decay that rings": ([-300 + 900j, -300 - 900j, -1.0, -2.0], 10.0, "Radau"),
    "all decays at one rate, for long": ([-600.0, -600.0, -500.0, -500.0], 9.5, "BDF"),
    "growth": ([600.0, -600.0, 550.0, -550.0], 9.5, "DOP853"),
}


@pytest.mark.parametrize("case", MODES)
def test_the_method_follows_the_modes(case: str) -> None:
    modes, t_end, method = MODES[case]
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
    assert choose(basis @ blocks @ np.linalg.inv(basis), t_end) == method
