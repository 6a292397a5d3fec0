"""Order of convergence of the integration methods: errors when the step size is halved.

A gentle motion past the equilibrium, against an integration of the numpy five-bar.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.native import StopReason
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.scene.scene import load_scene
from ckc_pin.scene.spec import Method
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.convergence.steps import steps_of

T_END = 0.5  # s; step sizes are powers of two, so that they add up without rounding
START, RATE = FIVE_BAR.equilibrium()[Q], np.array([1.0, 1.0])
EPSILON = 0.2  # s; large, so that explicit methods have their order on eq. 8 too
W = np.array([0.03, 0.0])  # phi of a base that is longer by this
OFF_MANIFOLD = {"reduced": False, "dae": False, "eq. 17": True, "eq. 8": True}  # whether the start is off the manifold

# name, rtol that selects the number of stages, order, lowest order of the output between steps, steps
METHODS = {
    "RK45": ("RK45", 0.1, 5, 4, 16),
    "DOP853": ("DOP853", 0.1, 8, 7, 8),
    "Radau, 3 stages": ("Radau", 0.1, 5, 3, 16),
    "Radau, 5 stages": ("Radau", 1e-4, 9, 5, 8),
    "Radau, 7 stages": ("Radau", 1e-8, 13, 7, 4),
}

ROUNDING = 3e-13  # rad, rad/s; error of loops closed to 1e-13

Exact = Callable[[float], Array]


@pytest.fixture(scope="module")
def exact() -> dict[bool, Exact]:
    """(q, q_dot) on the manifold and off it, by eq. 6 with the closed-form sigma."""

    def motion(off: bool) -> Exact:
        def rhs(t: float, y: Array) -> Array:
            moved = replace(FIVE_BAR, base=FIVE_BAR.base + off * W[0] * np.exp(-t / EPSILON))
            return np.concatenate([y[2:], FIVE_BAR.acceleration(moved.sigma(y[:2]), y[2:], np.zeros(2))])

        start, options = np.concatenate([START, RATE]), {"rtol": 3e-14, "atol": 1e-15, "max_step": 0.005}
        return solve_ivp(rhs, (0, T_END), start, method="DOP853", dense_output=True, **options).sol

    return {off: motion(off) for off in (False, True)}


def ready_at(formulation: str, **solver: Any) -> Prepared:
    """A native loop that closes the kinematic loops to rounding at every rtol."""
    overrides: dict[str, Any] = {"formulation": "spf" if OFF_MANIFOLD[formulation] else formulation, "epsilon": EPSILON}
    if OFF_MANIFOLD[formulation]:
        overrides |= {"initial.w": W.tolist(), "spf_coordinates": "z" if formulation == "eq. 8" else "w"}
    q, q_dot = ({"theta_1": float(x[0]), "theta_3": float(x[1])} for x in (START, RATE))
    overrides |= {"initial.q": q, "initial.q_dot": q_dot, **{f"solver.{key}": value for key, value in solver.items()}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ckc_pin.run.prepare.CLOSURE_TOLERANCE", 0.0)
        return prepare(load_scene("five_bar/swing", overrides))


def errors(exact: Exact, formulation: str, method: str, rtol: float, steps: int) -> tuple[float, float]:
    """Largest errors of (q, q_dot) at the ends of steps and within them, all steps equal."""
    h = T_END / steps
    ready = ready_at(formulation, method=method, rtol=rtol, atol=100.0, max_step=h)
    ready.loop.newton_tolerance = 1e-16

    def begin() -> None:
        ready.begin()
        ready.loop.step_size = h  # instead of the short one it would begin with

    ends = steps_of(ready.loop, begin, T_END)
    assert ends == pytest.approx(h * np.arange(1, steps + 1), rel=1e-12)
    within = np.sort(np.concatenate([ends - x * h for x in (0.1, 0.4, 0.7)]))
    largest = []
    for times in (ends, within):
        rows = np.empty((len(times) + 1, ready.loop.width))
        begin()
        ready.loop.record(times, rows)
        assert ready.loop.advance(T_END, final=True, pause=math.inf, budget=math.inf).reason == StopReason.END
        largest.append(max(np.abs(row[[1, 3, 5, 7]] - exact(row[0])).max() for row in rows[: len(times)]))
    return largest[0], largest[1]


def test_the_order_of_every_method_is_measured() -> None:
    assert {name for name, *_ in METHODS.values()} | {"auto"} == set(get_args(Method))


@pytest.mark.parametrize("formulation", OFF_MANIFOLD)
@pytest.mark.parametrize("method", METHODS)
def test_method_has_its_order_of_convergence(exact: dict[bool, Exact], formulation: str, method: str) -> None:
    """Projection, the Newton iteration on z and w do not change the order."""
    name, rtol, order, order_between, steps = METHODS[method]
    coarse, fine = (errors(exact[OFF_MANIFOLD[formulation]], formulation, name, rtol, n) for n in (steps, 2 * steps))
    at_ends, between = np.log2(np.array(coarse) / np.array(fine))
    assert at_ends == pytest.approx(order, rel=0.06) or fine[0] < ROUNDING
    assert between > order_between - 0.3


@pytest.mark.parametrize("stages", [2, 3])
def test_collocation_step_has_its_order_of_convergence(exact: dict[bool, Exact], stages: int) -> None:
    """The step across a loss of rank has order 2 s, so the error of one step has order 2 s + 1."""
    ready = ready_at("dae")

    def error(span: float) -> float:
        ready.begin()
        end = ready.loop.collocate(span, stages)
        return float(np.abs(end[[0, 2, 4, 6]] - exact[False](span)).max())

    assert np.log2(error(0.04) / error(0.02)) == pytest.approx(2 * stages + 1, abs=0.3)
