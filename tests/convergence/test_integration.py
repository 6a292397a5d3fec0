"""Errors of the swing relative to an integration of the NumPy five-bar, at steps and between steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.native import StopReason
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import load_scene
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import assert_close
from tests.convergence.steps import steps_of
from tests.regression.reference import trajectory

T_END = 0.5
START = FIVE_BAR.equilibrium()[Q] + 0.5
SHORTEST = 1e-5  # s; in shorter steps the rounding of q, divided by the step size, dominates the interpolated rates

Exact = Callable[[float], Array]
formulations = pytest.mark.parametrize("formulation", ["reduced", "dae"])


@pytest.fixture(scope="module")
def exact() -> Exact:
    """(q, q_dot) of the swing at any time, accurate to about 1e-14: eq. 6 with the closed-form sigma."""

    def rhs(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    start = np.concatenate([START, np.zeros(2)])
    # short steps: the dense output is of order 7
    return solve_ivp(
        rhs, (0, T_END), start, method="DOP853", rtol=3e-14, atol=1e-15, max_step=0.01, dense_output=True
    ).sol


def errors(exact: Exact, formulation: str, **solver: Any) -> tuple[Array, Array]:
    """Largest errors of (q, q_dot) at the steps and at three instants within each."""
    overrides = {f"solver.{key}": value for key, value in solver.items()}
    start = {"theta_1": float(START[0]), "theta_3": float(START[1])}
    ready = prepare(load_scene("five_bar/swing", {"formulation": formulation, "initial.q": start, **overrides}))

    def error(t: float, q_tree: Array, v_tree: Array) -> Array:
        gap = np.abs(np.concatenate([q_tree[Q], v_tree[Q]]) - exact(t))
        return np.array([gap[:2].max(), gap[2:].max()])

    ends = steps_of(ready.loop, ready.begin, T_END)
    starts = np.concatenate([[0.0], ends[:-1]])
    long_enough = ends - starts > SHORTEST
    within = np.sort(np.concatenate([(starts + x * (ends - starts))[long_enough] for x in (0.25, 0.5, 0.75)]))
    largest = []
    for times in (ends, within):
        rows = np.empty((len(times) + 1, ready.loop.width))
        ready.begin()
        ready.loop.record(times, rows)
        assert ready.loop.advance(T_END, final=True, pause=math.inf, budget=math.inf).reason == StopReason.END
        largest.append(np.max([error(row[0], row[1:5], row[5:9]) for row in rows[: len(times)]], axis=0))
    return largest[0], largest[1]


@formulations
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_errors_decrease_with_rtol(exact: Exact, formulation: str, method: str) -> None:
    """Errors decrease by more than half the decades of rtol and stay below a multiple of rtol, also between steps."""
    tolerances = np.array([1e-4, 1e-6, 1e-8, 1e-10])
    largest = np.array([errors(exact, formulation, method=method, rtol=rtol) for rtol in tolerances])
    for of_q, of_q_dot in largest.transpose(1, 2, 0):
        assert np.all(of_q <= 3 * tolerances)
        assert np.all(of_q_dot <= 20 * tolerances)  # rates reach 4 rad/s
    along = largest.max(axis=1)
    assert np.all(along[1:] < 0.1 * along[:-1])


@formulations
def test_radau_outputs_between_steps_are_as_accurate_as_steps(exact: Exact, formulation: str) -> None:
    """The interpolant of the stages has a lower order and would be less accurate."""
    at_steps, between = errors(exact, formulation, method="Radau", rtol=1e-8)
    assert np.all(between <= 15 * at_steps)


def test_reference_matches_the_stored_solution(exact: Exact) -> None:
    stored = trajectory("swing")
    assert_close(exact(0.5), np.concatenate([stored.q_tree[0, Q], stored.v_tree[0, Q]]), 1e-12)
