"""Prediction of z along a motion of the numpy five-bar, whose sigma is in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin.kinematics.sigma import sigma
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from tests.analytic.five_bar import FIVE_BAR, Array, Q, Z
from tests.conftest import Pair, assert_close

NODES, KEPT = 3, 8


def test_weights_are_exact_for_polynomials_of_their_degree() -> None:
    random = np.random.default_rng(0)
    for k in (1, 2, 3):
        p = np.polynomial.Polynomial(random.normal(size=2 * k))
        nodes, t = random.uniform(-1, 1, k), float(random.uniform(-1, 1))
        a, b = _core.hermite_weights(nodes, t)
        assert_close(a @ p(nodes) + b @ p.deriv()(nodes), p(t), 1e-10)
        q = np.polynomial.Polynomial(random.normal(size=2 * k + 1))
        assert abs(a @ q(nodes) + b @ q.deriv()(nodes) - q(t)) > 1e-6


def motion(t: float) -> tuple[Array, Array]:
    """q and q_dot of some smooth motion."""
    return (
        np.array([-1.4 + 0.5 * np.sin(2 * t), -1.7 + 0.4 * np.cos(1.3 * t)]),
        np.array([np.cos(2 * t), -0.52 * np.sin(1.3 * t)]),
    )


def predictor(pair: Pair, q: Array, epsilon: float = 1.0) -> Any:
    """A predictor that starts from q on the closure."""
    return _core.Predictor(core_table(pair[0]), FIVE_BAR.sigma(q), epsilon)


def error_of_prediction(pair: Pair, h: float, points: int, aside: float = 0.0) -> float:
    """Of z, a step h ahead of so many points h apart, q off the motion by `aside`."""
    foretells = predictor(pair, motion(0.0)[0])
    for k in range(points):
        q, q_dot = motion(k * h)
        q_tree = FIVE_BAR.sigma(q)
        foretells.add(k * h, q_tree, FIVE_BAR.rho(q_tree) @ q_dot, np.zeros(2))
    wanted = motion(points * h)[0] + aside
    found = foretells.predict(points * h, wanted, np.zeros(2))
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


def test_the_nearest_times_are_kept(five_bar: Pair) -> None:
    """After many more points than that, the prediction is that of the last ones."""
    assert error_of_prediction(five_bar, 0.01, 4 * KEPT) < 1e-7


def test_the_level_is_predicted_where_its_decay_is_resolved(five_bar: Pair) -> None:
    """Off the manifold: phi = w0 exp(-t / epsilon), by the numpy five-bar's phi."""
    mechanism, epsilon = five_bar[0], 0.1
    w0, misses = np.array([0.01, -0.006]), []
    for h in (0.02, 0.01):
        foretells = predictor(five_bar, motion(0.0)[0], epsilon)
        for k in range(NODES):
            q, q_dot = motion(k * h)
            w = w0 * np.exp(-k * h / epsilon)
            at = sigma(mechanism, q, w=w).at
            v_tree = FIVE_BAR.rho(at.q_tree) @ q_dot
            v_tree[Z] += np.linalg.solve(FIVE_BAR.phi_z(at.q_tree), -w / epsilon)
            foretells.add(k * h, at.q_tree, v_tree, w)
        t = NODES * h
        w = w0 * np.exp(-t / epsilon)
        found = foretells.predict(t, motion(t)[0], w)
        misses.append(float(np.abs(FIVE_BAR.phi(found) - w).max()))
    assert misses[1] < misses[0] / 30
    assert misses[1] < 1e-7


def test_points_beside_the_motion_foretell_no_worse_than_the_nearest(five_bar: Pair) -> None:
    """Points close together in time, off the motion as stages of coarse steps are, and a time far from them all."""
    random = np.random.default_rng(3)
    for _ in range(20):
        foretells = predictor(five_bar, motion(0.0)[0])
        visited = []
        for t in (0.0600, 0.0693, 0.07092):
            q, q_dot = motion(t)
            q = q + random.uniform(-0.02, 0.02, 2)
            q_tree = FIVE_BAR.sigma(q)
            visited.append(q_tree)
            foretells.add(t, q_tree, FIVE_BAR.rho(q_tree) @ q_dot, np.zeros(2))
        wanted = motion(0.055)[0]
        truth = FIVE_BAR.sigma(wanted)
        nearest = min(float(np.abs(q_tree - truth)[Q].max()) for q_tree in visited)
        error = np.abs(foretells.predict(0.055, wanted, np.zeros(2)) - truth)[Z].max()
        assert error < 10 * nearest**2
