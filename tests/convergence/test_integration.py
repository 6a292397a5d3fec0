"""Errors of the swing against an integration of the numpy five-bar: by tolerance, at steps and between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.dynamics import Terms
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.scene import SolverSpec
from ckc_pin.simulation.systems import Dae, LevelSet, System
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import Pair, assert_close
from tests.regression.reference import trajectory

T_END = 0.5
START = FIVE_BAR.equilibrium()[Q] + 0.5
SHORTEST = 1e-5  # s: in a shorter step the rounding of q over the step shows in the interpolated rates

Exact = Callable[[float], Array]
formulations = pytest.mark.parametrize("formulation", ["reduced", "dae"])


@pytest.fixture(scope="module")
def exact() -> Exact:
    """(q, q_dot) of the swing, to some 1e-14 at any time: eq. 6 on the closed-form sigma."""

    def rhs(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    start = np.concatenate([START, np.zeros(2)])
    # short steps: the dense output is of order 7
    return solve_ivp(
        rhs, (0, T_END), start, method="DOP853", rtol=3e-14, atol=1e-15, max_step=0.01, dense_output=True
    ).sol


def errors(pair: Pair, exact: Exact, formulation: str, method: str, **solver: Any) -> tuple[Array, Array]:
    """Largest errors of (q, q_dot) at the steps and at three instants within each."""
    mechanism, _ = pair
    start = mechanism.sigma(START).at

    def no_force(t: float, terms: Terms) -> Array:
        return np.zeros(4)

    system: System = LevelSet(mechanism, start, np.zeros(2), no_force)
    if formulation == "dae":
        system = Dae(mechanism, start, np.zeros(4), no_force)
    stepper = Stepper(system, method, SolverSpec(**solver), T_END)

    def error(t: float, y: Array) -> Array:
        q, q_dot = (y[:2], y[2:]) if formulation == "reduced" else (y[Q], y[4:][Q])
        gap = np.abs(np.concatenate([q, q_dot]) - exact(t))
        return np.array([gap[:2].max(), gap[2:].max()])

    at_steps, between = [], []
    while stepper.solver.status == "running":
        step = stepper.step()
        at_steps.append(error(step.t, stepper.solver.y))
        if step.t - step.t_old > SHORTEST:
            times = step.t_old + np.array([0.25, 0.5, 0.75]) * (step.t - step.t_old)
            between += [error(t, step.interpolant(t)) for t in times]
    return np.max(at_steps, axis=0), np.max(between, axis=0)


@formulations
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_errors_fall_with_the_tolerance(five_bar: Pair, exact: Exact, formulation: str, method: str) -> None:
    """At steps and between: by more than half the decades that rtol falls, and never far above rtol itself."""
    tolerances = np.array([1e-4, 1e-6, 1e-8, 1e-10])
    found = np.array([errors(five_bar, exact, formulation, method, rtol=rtol) for rtol in tolerances])
    for of_q, of_q_dot in found.transpose(1, 2, 0):
        assert np.all(of_q <= 3 * tolerances)
        assert np.all(of_q_dot <= 20 * tolerances)  # rates reach 4 rad/s
    assert np.all(found[1:] < 0.1 * found[:-1])


@formulations
def test_outputs_of_Radau_between_steps_are_as_good_as_its_steps(
    five_bar: Pair, exact: Exact, formulation: str
) -> None:
    """Its own interpolant is of order 3 and would be off by thousands of times as much."""
    at_steps, between = errors(five_bar, exact, formulation, "Radau", rtol=1e-8)
    assert np.all(between <= 15 * at_steps)


def test_the_reference_is_the_stored_one(exact: Exact) -> None:
    stored = trajectory("swing")
    assert_close(exact(0.5), np.concatenate([stored.q_tree[0, Q], stored.v_tree[0, Q]]), 1e-12)
