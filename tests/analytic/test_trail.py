"""Prediction of z along a motion of the numpy five-bar, whose sigma is in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin.mechanism.chart import Chart
from ckc_pin.simulation.systems.trail import KEPT, NODES, Trail, hermite_weights
from tests.analytic.five_bar import FIVE_BAR, Array, Q, Z
from tests.conftest import Pair, assert_close


def test_weights_are_exact_for_polynomials_of_their_degree() -> None:
    random = np.random.default_rng(0)
    for k in (1, 2, 3):
        p = np.polynomial.Polynomial(random.normal(size=2 * k))
        nodes, t = list(random.uniform(-1, 1, k)), float(random.uniform(-1, 1))
        a, b = hermite_weights(nodes, t)
        value = sum(x * p(node) + y * p.deriv()(node) for node, x, y in zip(nodes, a, b, strict=True))
        assert_close(value, p(t), 1e-10)
        q = np.polynomial.Polynomial(random.normal(size=2 * k + 1))
        beyond = sum(x * q(node) + y * q.deriv()(node) for node, x, y in zip(nodes, a, b, strict=True))
        assert abs(beyond - q(t)) > 1e-6


def motion(t: float) -> tuple[Array, Array]:
    """q and q_dot of some smooth motion."""
    return (
        np.array([-1.4 + 0.5 * np.sin(2 * t), -1.7 + 0.4 * np.cos(1.3 * t)]),
        np.array([np.cos(2 * t), -0.52 * np.sin(1.3 * t)]),
    )


def error_of_prediction(pair: Pair, h: float, points: int, aside: float = 0.0) -> float:
    """Of z, a step h ahead of so many points h apart, q off the motion by `aside`."""
    mechanism, _ = pair
    q, _ = motion(0.0)
    start = mechanism.sigma(q).at
    trail, chart, zero = Trail(start), Chart(mechanism.tree, mechanism.partition.q, start.q_tree), np.zeros(2)
    for k in range(points):
        q, q_dot = motion(k * h)
        at = mechanism.sigma(q).at
        trail.add(k * h, at, at.rho @ q_dot, zero)
    wanted = motion(points * h)[0] + aside
    found = trail.predict(points * h, wanted, chart, zero).q_tree
    assert_close(found[Q], wanted, 1e-15)
    return float(np.abs(found - FIVE_BAR.sigma(wanted))[Z].max())


@pytest.mark.parametrize(("points", "order"), [(1, 2), (2, 4), (3, 6)])
def test_the_order_of_prediction(five_bar: Pair, points: int, order: int) -> None:
    coarse, fine = (error_of_prediction(five_bar, h, points) for h in (0.05, 0.025))
    assert 2 ** (order - 0.7) < coarse / fine < 2 ** (order + 1.5)


def test_q_off_the_motion_is_followed_to_first_order(five_bar: Pair) -> None:
    """What the stages of a method do: the error is a product of how far aside and ahead, and of squares of either."""
    coarse, fine = (error_of_prediction(five_bar, h, NODES, aside=h) for h in (0.01, 0.005))
    assert 3 < coarse / fine < 5


def test_a_trail_keeps_the_nearest_times(five_bar: Pair) -> None:
    """After many more points than it keeps, the prediction is that of the last ones."""
    assert error_of_prediction(five_bar, 0.01, 4 * KEPT) < 1e-7


def test_the_level_is_predicted_where_its_decay_is_resolved(five_bar: Pair) -> None:
    """Off the manifold: phi = w0 exp(-t / epsilon), by the numpy five-bar's phi."""
    mechanism, epsilon = five_bar[0], 0.1
    w0, misses = np.array([0.01, -0.006]), []
    for h in (0.02, 0.01):
        q, _ = motion(0.0)
        start = mechanism.sigma(q).at
        trail, chart = Trail(start, epsilon), Chart(mechanism.tree, mechanism.partition.q, start.q_tree)
        for k in range(NODES + 1):
            t, (q, q_dot) = k * h, motion(k * h)
            w = w0 * np.exp(-t / epsilon)
            at = mechanism.sigma(q, start=start, w=w).at if k < NODES else trail.predict(t, q, chart, w)
            if k < NODES:
                v_tree = at.rho @ q_dot
                v_tree[Z] += np.linalg.solve(FIVE_BAR.phi_z(at.q_tree), -w / epsilon)
                trail.add(t, at, v_tree, w)
        misses.append(float(np.abs(FIVE_BAR.phi(at.q_tree) - w).max()))
    assert misses[1] < misses[0] / 30
    assert misses[1] < 1e-7
