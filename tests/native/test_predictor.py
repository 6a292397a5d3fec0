"""Prediction of z along a motion of the NumPy five-bar, whose sigma has a closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin.kinematics.sigma import sigma
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from tests.analytic.five_bar import FIVE_BAR, Array, Q, Z
from tests.conftest import Pair, assert_close

NODES, CAPACITY = 3, 8


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
    """Return q and q_dot of a smooth motion."""
    return (
        np.array([-1.4 + 0.5 * np.sin(2 * t), -1.7 + 0.4 * np.cos(1.3 * t)]),
        np.array([np.cos(2 * t), -0.52 * np.sin(1.3 * t)]),
    )


def make_predictor(pair: Pair, q: Array, epsilon: float = 1.0) -> Any:
    """Return a predictor that starts from q on the constraint manifold."""
    return _core.Predictor(core_table(pair[0]), FIVE_BAR.sigma(q), epsilon)


def error_of_prediction(pair: Pair, h: float, points: int, offset: float = 0.0) -> float:
    """Return the error of z predicted a step h after `points` points at distance h, at q off the motion by `offset`."""
    predictor = make_predictor(pair, motion(0.0)[0])
    for k in range(points):
        q, q_dot = motion(k * h)
        q_tree = FIVE_BAR.sigma(q)
        predictor.add(k * h, q_tree, FIVE_BAR.rho(q_tree) @ q_dot, np.zeros(2))
    q = motion(points * h)[0] + offset
    predicted = predictor.predict(points * h, q, np.zeros(2))
    assert_close(predicted[Q], q, 1e-15)
    return float(np.abs(predicted - FIVE_BAR.sigma(q))[Z].max())


@pytest.mark.parametrize(("points", "order"), [(1, 2), (2, 4), (3, 6)])
def test_prediction_has_order_two_per_point(five_bar: Pair, points: int, order: int) -> None:
    coarse, fine = (error_of_prediction(five_bar, h, points) for h in (0.05, 0.025))
    assert 2 ** (order - 0.7) < coarse / fine < 2 ** (order + 1.5)


def test_prediction_off_the_motion_is_of_second_order(five_bar: Pair) -> None:
    """Stages of a method are off the motion. The error is of second order in the offset and the step together."""
    coarse, fine = (error_of_prediction(five_bar, h, NODES, offset=h) for h in (0.01, 0.005))
    assert 3 < coarse / fine < 5


def test_most_recent_points_are_used(five_bar: Pair) -> None:
    """After more points than the predictor's capacity, it uses the last ones."""
    assert error_of_prediction(five_bar, 0.01, 4 * CAPACITY) < 1e-7


def test_decay_of_w_is_predicted(five_bar: Pair) -> None:
    """Off the manifold phi = w0 exp(-t / epsilon), computed by the NumPy five-bar."""
    mechanism, epsilon = five_bar[0], 0.1
    w0, errors = np.array([0.01, -0.006]), []
    for h in (0.02, 0.01):
        predictor = make_predictor(five_bar, motion(0.0)[0], epsilon)
        for k in range(NODES):
            q, q_dot = motion(k * h)
            w = w0 * np.exp(-k * h / epsilon)
            at = sigma(mechanism, q, w=w).at
            v_tree = FIVE_BAR.rho(at.q_tree) @ q_dot
            v_tree[Z] += np.linalg.solve(FIVE_BAR.phi_z(at.q_tree), -w / epsilon)
            predictor.add(k * h, at.q_tree, v_tree, w)
        t = NODES * h
        w = w0 * np.exp(-t / epsilon)
        predicted = predictor.predict(t, motion(t)[0], w)
        errors.append(float(np.abs(FIVE_BAR.phi(predicted) - w).max()))
    assert errors[1] < errors[0] / 30
    assert errors[1] < 1e-7


def test_prediction_from_points_off_the_motion_is_as_accurate_as_the_nearest_point(five_bar: Pair) -> None:
    """The points are close together in time and off the motion, like stages of a large step. The time is far away."""
    random = np.random.default_rng(3)
    for _ in range(20):
        predictor = make_predictor(five_bar, motion(0.0)[0])
        visited = []
        for t in (0.0600, 0.0693, 0.07092):
            q, q_dot = motion(t)
            q = q + random.uniform(-0.02, 0.02, 2)
            q_tree = FIVE_BAR.sigma(q)
            visited.append(q_tree)
            predictor.add(t, q_tree, FIVE_BAR.rho(q_tree) @ q_dot, np.zeros(2))
        q = motion(0.055)[0]
        truth = FIVE_BAR.sigma(q)
        nearest = min(float(np.abs(q_tree - truth)[Q].max()) for q_tree in visited)
        error = np.abs(predictor.predict(0.055, q, np.zeros(2)) - truth)[Z].max()
        assert error < 10 * nearest**2
