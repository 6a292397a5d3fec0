"""Eqs. 14, 16 and 18 at random states, the controller's model the plant or another five-bar, against numpy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from ckc_pin import InputError, load
from ckc_pin.control import Harmonics, SetPoint, Tracking
from ckc_pin.control.controllers import ControllerModel
from ckc_pin.control.spec import MotionSpec
from ckc_pin.dynamics import Terms
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR, Array, Q, complex_step, desired, set_point, tracking
from tests.conftest import Pair, assert_close

EQ_21 = Harmonics(
    [
        MotionSpec(harmonics=[(np.pi / 3, 1.0, 0.0)]),
        MotionSpec(offset=np.pi / 4, harmonics=[(np.pi / 4, 1.0, -np.pi / 2)]),
    ]
)
LAMBDA, K_D = np.array([[1.5, 0.0], [0.0, 2.0]]), np.array([[10.0, 0.0], [0.0, 7.0]])


def states(off: float = 0.0) -> Iterator[tuple[float, Array, Array]]:
    """Times, q' (off the manifold by `off`) and q_dot near eq. 21."""
    random = np.random.default_rng(0)
    for t in random.uniform(0, 10, 50):
        q_tree = FIVE_BAR.sigma(desired(t)[0] + random.uniform(-0.1, 0.1, 2))
        yield t, q_tree + off * random.uniform(-1, 1, 4), random.uniform(-3, 3, 2)


def plant_terms(pair: Pair, q_tree: Array, v_tree: Array) -> Terms:
    return Terms(pair[0], pair[0].kinematics(q_tree), v_tree)


def test_eq_21_as_harmonics() -> None:
    for t in np.linspace(0, 10, 41):
        for ours, theirs in zip(EQ_21(t), desired(t), strict=True):
            assert_close(ours, theirs, 1e-14)


def test_set_point_torques_with_exact_and_wrong_model(five_bar: Pair) -> None:
    q_d = np.array([np.pi / 4, np.pi / 4])
    for name, model in (("five_bar", FIVE_BAR), ("five_bar_as_printed", AS_PRINTED)):
        ours, theirs = SetPoint(load(name), 10 * np.eye(2), np.eye(2), q_d), set_point(model, q_d)
        for t, q_tree, q_dot in states(off=0.05):
            terms = plant_terms(five_bar, q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
            assert_close(ours.u(t, terms), theirs(t, q_tree, q_dot), 1e-12)
            assert_close(ours.u_rate_gradient(t, terms), -np.eye(2), 0)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_tracking_torques_with_exact_and_wrong_model(five_bar: Pair, off: float) -> None:
    """The wrong one has other lengths: its rho, and with it the velocity in its C, are its own."""
    wrong = ControllerModel(load("five_bar_as_printed"), five_bar[0], "rho")
    for model, reference in ((None, FIVE_BAR), (wrong, AS_PRINTED)):
        ours, theirs = Tracking(np.eye(2), 10 * np.eye(2), EQ_21, model), tracking(reference)
        for t, q_tree, q_dot in states(off):
            terms = plant_terms(five_bar, q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
            assert_close(ours.u(t, terms), theirs(t, q_tree, q_dot), 1e-11)


def test_tracking_with_the_actual_velocity_in_C(five_bar: Pair) -> None:
    """Eq. 16's convention, plant and controller alike: C at whatever v' is measured."""
    model = ControllerModel(load("five_bar_as_printed"), five_bar[0], "actual")
    ours, random = Tracking(LAMBDA, K_D, EQ_21, model), np.random.default_rng(1)
    for t, q_tree, _ in states(off=0.05):
        v_tree = random.uniform(-5, 5, 4)
        q_d, q_d_dot, q_d_ddot = desired(t)
        v, a = q_d_dot - LAMBDA @ (q_tree[Q] - q_d), q_d_ddot - LAMBDA @ (v_tree[Q] - q_d_dot)
        u = AS_PRINTED.D(q_tree) @ a + AS_PRINTED.C(q_tree, v_tree) @ v + AS_PRINTED.h(q_tree)
        assert_close(ours.u(t, plant_terms(five_bar, q_tree, v_tree)), u - K_D @ (v_tree[Q] - v), 1e-11)


def test_rate_gradient_is_the_derivative_along_q_dot(five_bar: Pair) -> None:
    """d u / d q_dot, what stiffness comes from: by a complex step on the numpy controller's formula."""
    model = ControllerModel(load("five_bar_as_printed"), five_bar[0], "rho")
    ours = Tracking(LAMBDA, K_D, EQ_21, model)
    for t, q_tree, q_dot in states():
        q_d, q_d_dot, _ = desired(t)
        v = q_d_dot - LAMBDA @ (q_tree[Q] - q_d)
        rho = AS_PRINTED.rho(q_tree)

        def u(rate: Array, q_tree: Array = q_tree, v: Array = v, rho: Array = rho, q_d_dot: Array = q_d_dot) -> Array:
            a = -LAMBDA @ (rate - q_d_dot)
            return AS_PRINTED.D(q_tree) @ a + AS_PRINTED.C(q_tree, rho @ rate) @ v - K_D @ (rate - v)

        terms = plant_terms(five_bar, q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
        assert_close(ours.u_rate_gradient(t, terms), complex_step(u, q_dot), 1e-12, relative=True)


def test_lyapunov_of_tracking_is_eq_18(five_bar: Pair) -> None:
    ours = Tracking(LAMBDA, K_D, EQ_21)
    for t, q_tree, q_dot in states(off=0.05):
        q_d, q_d_dot, _ = desired(t)
        error, w = q_tree[Q] - q_d, FIVE_BAR.phi(q_tree)
        r = q_dot - q_d_dot + LAMBDA @ error
        V = r @ FIVE_BAR.D(q_tree) @ r / 2 + error @ LAMBDA.T @ K_D @ error + w @ w / 2
        terms = plant_terms(five_bar, q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
        assert_close(ours.lyapunov(t, terms, w), V, 1e-12)


def test_set_point_lyapunov_function_decreases_by_K_V_only(five_bar: Pair) -> None:
    """dV/dt = -q_dot K_V q_dot along the closed loop: section II-B, with D, C, h in numpy."""
    q_d, K_P, K_V, step = np.array([np.pi / 4, np.pi / 4]), 10 * np.eye(2), np.diag([1.0, 2.0]), 1e-4
    ours = SetPoint(five_bar[0], K_P, K_V, q_d)
    for t, q_tree, q_dot in states():
        terms = plant_terms(five_bar, q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
        q_ddot = FIVE_BAR.acceleration(q_tree, q_dot, ours.u(t, terms))

        def V(time: float, q: Array = q_tree[Q], q_dot: Array = q_dot, q_ddot: Array = q_ddot) -> float:
            moved, rate = FIVE_BAR.sigma(q + time * q_dot), q_dot + time * q_ddot
            return ours.lyapunov(0.0, plant_terms(five_bar, moved, FIVE_BAR.rho(moved) @ rate), np.zeros(2))

        slope = (8 * (V(step) - V(-step)) - V(2 * step) + V(-2 * step)) / (12 * step)
        assert_close(slope, -q_dot @ K_V @ q_dot, 1e-8)


def test_gains_must_be_symmetric_positive_definite(five_bar: Pair) -> None:
    """Lambda^T K_D too, which Lambda and K_D alone do not imply."""
    skewed = np.array([[1.0, 0.5], [0.0, 1.0]])
    for Lambda, gain in ((np.eye(2), -np.eye(2)), (np.eye(2), skewed), (skewed, K_D), (-np.eye(2), K_D)):
        with pytest.raises(InputError, match=r"not (symmetric|positive definite)"):
            Tracking(Lambda, gain, EQ_21)
