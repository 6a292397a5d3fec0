"""The order of every method that has one: what halving the steps does to the error.

A gentle motion past the equilibrium, against an integration of the numpy five-bar. BDF, LSODA and IDA choose their
order as they go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.dynamics import Terms
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.leap import _collocated
from ckc_pin.simulation.scene import SolverSpec
from ckc_pin.simulation.systems import Dae, LevelSet, PrintedSpf, System
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import Pair

T_END = 0.5  # s, and steps by powers of two, so that they add up without rounding
START, RATE = FIVE_BAR.equilibrium()[Q], np.array([1.0, 1.0])
EPSILON = 0.2  # s: slow, so that explicit methods show their order on eq. 8 too
W = np.array([0.03, 0.0])  # a base longer by that much
OFF = {"reduced": False, "dae": False, "eq. 17": True, "eq. 8": True}  # formulations, whether off the manifold

# method: its order, that of its output between steps (at least), steps to the end
METHODS = {"RK23": (3, 3, 16), "RK45": (5, 4, 16), "DOP853": (8, 7, 8), "Radau": (5, 4, 16)}

Exact = Callable[[float], Array]


@pytest.fixture(scope="module")
def exact() -> dict[bool, Exact]:
    """(q, q_dot) on the manifold and off it, by eq. 6 on the closed-form sigma."""

    def motion(off: bool) -> Exact:
        def rhs(t: float, y: Array) -> Array:
            moved = replace(FIVE_BAR, base=FIVE_BAR.base + off * W[0] * np.exp(-t / EPSILON))
            return np.concatenate([y[2:], FIVE_BAR.acceleration(moved.sigma(y[:2]), y[2:], np.zeros(2))])

        start, options = np.concatenate([START, RATE]), {"rtol": 3e-14, "atol": 1e-15, "max_step": 0.02}
        return solve_ivp(rhs, (0, T_END), start, method="DOP853", dense_output=True, **options).sol

    return {off: motion(off) for off in (False, True)}


def no_force(t: float, terms: Terms) -> Array:
    return np.zeros(4)


def system(pair: Pair, formulation: str) -> System:
    mechanism, _ = pair
    w = W if OFF[formulation] else np.zeros(2)
    start = mechanism.sigma(START, w=w).at
    if formulation == "dae":
        return Dae(mechanism, start, FIVE_BAR.rho(start.q_tree) @ RATE, no_force)
    if formulation == "eq. 8":
        return PrintedSpf(mechanism, start, RATE, no_force, EPSILON, w)
    return LevelSet(mechanism, start, RATE, no_force, EPSILON, w0=w)


def errors(pair: Pair, exact: Exact, formulation: str, method: str, steps: int) -> tuple[float, float]:
    """Largest errors of (q, q_dot) at the ends of steps and within them, all steps equal."""
    h = T_END / steps
    stepper = Stepper(system(pair, formulation), method, SolverSpec(rtol=0.1, atol=1.0, max_step=h), T_END)
    stepper.solver.h_abs = h  # instead of the short one it would begin with
    stepper.solver.newton_tol = 1e-11
    at = [0, 2, 4, 6] if formulation == "dae" else [0, 1, 2, 3]
    at_ends, between = [], []
    while stepper.solver.status == "running":
        step = stepper.step()
        assert step.t - step.t_old == pytest.approx(h, rel=1e-12)
        times = step.t_old + np.array([0.3, 0.6, 0.9]) * h
        between += [np.abs(step.interpolant(t)[at] - exact(t)).max() for t in times]
        at_ends.append(np.abs(stepper.solver.y[at] - exact(step.t)).max())
        stepper.settle()
    return float(max(at_ends)), float(max(between))


@pytest.mark.parametrize("formulation", OFF)
@pytest.mark.parametrize("method", METHODS)
def test_observed_order(five_bar: Pair, exact: dict[bool, Exact], formulation: str, method: str) -> None:
    """Neither projection nor Newton's iteration on z nor w changes an order."""
    order, order_between, steps = METHODS[method]
    coarse, fine = (errors(five_bar, exact[OFF[formulation]], formulation, method, n) for n in (steps, 2 * steps))
    at_ends, between = np.log2(np.array(coarse) / np.array(fine))
    assert at_ends == pytest.approx(order, abs=0.3)
    assert between > order_between - 0.3


@pytest.mark.parametrize("stages", [2, 3])
def test_order_of_collocation(five_bar: Pair, exact: dict[bool, Exact], stages: int) -> None:
    """The leap across rank losses: of order 2 s at its end, which one step shows as 2 s + 1."""
    motion = system(five_bar, "reduced")
    y = motion.start()

    def rates(times: Array, states: Array) -> Array:
        return np.array([motion.rhs(float(t), y) for t, y in zip(times, states, strict=True)])

    def error(span: float) -> float:
        guess = np.tile(motion.rhs(0.0, y), (stages, 1))
        end = _collocated(rates, 0.0, y, span, guess)[0].sum(axis=0)  # Legendre polynomials are 1 there
        return float(np.abs(end - exact[False](span)).max())

    assert np.log2(error(0.02) / error(0.01)) == pytest.approx(2 * stages + 1, abs=0.3)
