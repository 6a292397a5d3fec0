"""Sampled closed loops against SciPy's discretization, nonlinear runs and perturbed tracking."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete

from ckc_pin import Sampled, check, load_scene, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import ClosedLoop, Feedback
from ckc_pin.linear.sampled_loop import build_sampled_loop, propagate_sampled_loop
from ckc_pin.linear.stability import stability
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step
from tests.analytic.test_stability import growth_by_runs, load_controlled

REST = FIVE_BAR.equilibrium()  # u is zero there, as it is before the first sample acts
TARGET = {"controller.q_d": dict(zip(("theta_1", "theta_3"), REST[[0, 2]].tolist(), strict=True))}
MIN_LOG_MULTIPLIER = 2e-3  # closer to a multiplier of 1, a run would have to be long


# --- one sample to the next ----------------------------------------------------------------------


def plant_of_appendix() -> tuple[Array, Array]:
    """A and B at the equilibrium, from the equations of the appendix."""

    def rate(x: Array) -> Array:
        moved = REST + FIVE_BAR.rho(REST) @ x[:2]
        return np.concatenate([x[2:4], FIVE_BAR.acceleration(moved, x[2:4], x[4:])])

    slopes = complex_step(rate, np.zeros(6))
    return slopes[:, :4], slopes[:, 4:]


@pytest.mark.parametrize("delay_samples", [0, 1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_multiplier_matches_scipys_zero_order_hold(seed: int, delay_samples: int) -> None:
    """A delay of whole samples is a chain of unit delays."""
    random = np.random.default_rng(seed)
    gains, period = 10.0 ** random.uniform([0.0, -1.0], [2.0, 1.0]), 10.0 ** random.uniform(-2.5, -1.0)
    A, B, *_ = cont2discrete((*plant_of_appendix(), np.eye(4), np.zeros((4, 2))), period)
    K = -np.hstack([gains[0] * np.eye(2), gains[1] * np.eye(2)])
    expected = np.zeros((4 + 2 * delay_samples, 4 + 2 * delay_samples))
    expected[:4, :4] = A
    if delay_samples:  # the state is x, then the pending u, the most recent one first
        expected[:4, -2:], expected[4:6, :4], expected[6:, 4:-2] = B, K, np.eye(2 * delay_samples - 2)
    else:
        expected += B @ K
    overrides = {**TARGET, "controller.K_P": float(gains[0]), "controller.K_V": float(gains[1])}
    result = stability(
        *load_controlled("five_bar/set_point", overrides), 1.0, sampling=(period, delay_samples * period)
    )
    assert result.sampled
    assert result.multiplier == pytest.approx(np.abs(np.linalg.eigvals(expected)).max(), rel=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013, 0.02, 0.027])
def test_the_sampled_matrix_predicts_a_nonlinear_run(delay: float) -> None:
    """The comparison begins when every u that acts comes from a sample.

    The target is the equilibrium, where u is zero, because u is zero before the first sample acts.
    """
    period, deviation, count = 0.01, 1e-5, 30
    q_d = FIVE_BAR.equilibrium()[[0, 2]]
    target = {"controller.q_d": dict(zip(("theta_1", "theta_3"), q_d.tolist(), strict=True))}
    mechanism, law = load_controlled("five_bar/set_point", target)
    start = {"q": dict(zip(mechanism.independent, (q_d + deviation * np.array([1, -0.5])).tolist(), strict=True))}
    q_tree = sigma(mechanism, law.q_d).at
    loop = ClosedLoop(mechanism, law).linearize(0.0, Terms(mechanism, q_tree, np.zeros(mechanism.n)))
    matrix = build_sampled_loop(loop, period, delay)

    m = int(np.floor(delay / period + 1e-9))
    overrides = {**target, "initial": start, "t_end": count * period, "solver.output_dt": period, "solver.rtol": 1e-12,
               "formulation": "reduced"}  # fmt: skip
    run = simulate("five_bar/set_point", overrides, controller=Sampled(law, period, delay))
    at = m + 1 if delay else 0  # from here on every pending u comes from a sample
    x = np.hstack([run.q_tree[:, [0, 2]] - q_d, run.v_tree[:, [0, 2]]])
    pending = (len(matrix) - 4) // 2
    y = np.concatenate([x[at], *(loop.K @ x[at - k] if at >= k else np.zeros(2) for k in range(1, pending + 1))])
    size = np.abs(x[at:]).max()
    for k in range(at, count + 1):
        assert np.abs(y[:4] - x[k]).max() <= 2e-3 * size
        y = matrix @ y


@pytest.mark.parametrize("seed", range(8))
def test_runs_settle_exactly_if_the_sampled_loop_is_stable(seed: int) -> None:
    """Random gains, sample times and delays; cases close to the stability boundary are drawn again."""
    random = np.random.default_rng(seed)
    while True:
        K_P, K_V, period = (float(10.0**x) for x in random.uniform([0.0, -1.0, -2.5], [2.0, 1.0, -1.0]))
        controller = {"controller.K_P": K_P, "controller.K_V": K_V, "controller.sample_time": period,
                      "controller.delay": float(random.choice([0.0, 0.4, 1.3])) * period}  # fmt: skip
        result = check(load_scene("five_bar/set_point", {**TARGET, **controller})).stability
        assert result is not None
        assert result.multiplier is not None
        if abs(np.log(result.multiplier)) > MIN_LOG_MULTIPLIER:
            break
    samples = int(np.ceil(7.0 / abs(np.log(result.multiplier)))) + 3
    q = dict(zip(("theta_1", "theta_3"), (REST[[0, 2]] + 1e-6 * random.uniform(-1, 1, 2)).tolist(), strict=True))
    start = {"initial": {"q": q}, "formulation": "reduced", "t_end": samples * period, "solver.rtol": 1e-10,
             "solver.output_dt": period, "solver.atol": 1e-14}  # fmt: skip
    run = simulate("five_bar/set_point", {**TARGET, **controller, **start})
    error = np.abs(run.q_tree[:, [0, 2]] - REST[[0, 2]]).max(axis=1)
    assert run.status == "done"
    assert result.stable == (result.multiplier < 1.0)
    if result.stable:
        assert error[-1] < 0.1 * error[0]
    else:
        assert error[-1] > 10 * error[0]


def test_a_long_sample_time_makes_a_set_point_unstable() -> None:
    results = []
    for period in (0.02, 0.2):
        scene = load_scene("five_bar/set_point", {"controller.sample_time": period})
        result = check(scene)
        assert result.stability is not None
        assert result.stability.leaves_out == ()
        assert result.stability.eigenvalues is not None
        assert result.stability.eigenvalues.real.max() < 0
        results.append((result.stability.stable, any("unstable as sampled" in x for x in result.warnings)))
    assert results == [(True, False), (False, True)]


# --- along a motion ------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.024])
def test_propagation_through_a_constant_loop_is_a_matrix_power(delay: float) -> None:
    random, period = np.random.default_rng(1), 0.01
    loop = Feedback(*(random.uniform(-1, 1, size) for size in ((4, 4), (4, 2), (2, 4))))
    start, matrix = random.uniform(-1, 1, (4, 2)), build_sampled_loop(loop, period, delay)
    states = propagate_sampled_loop([loop] * 7, 5 * period, start, period, delay)
    state = np.vstack([start, np.zeros((len(matrix) - 4, 2))])
    assert len(states) == 8
    for k, (x, log) in enumerate(states):
        assert np.abs(np.exp(log) * x - state[:4]).max() <= 1e-9 * np.abs(state).max(), k
        state = np.linalg.matrix_power(matrix, 5) @ state


@pytest.mark.parametrize(("period", "delay"), [(1e-3, 0.0), (1e-3, 4e-4), (5e-4, 12e-4)])
def test_growth_of_sampled_tracking_matches_perturbed_runs(period: float, delay: float) -> None:
    """Up to the distance between the sampled and the desired motion, which all runs share."""
    t_end = 1.5
    result = stability(*load_controlled("five_bar/tracking"), t_end, sampling=(period, delay))
    assert result.sampled
    sampled = {"controller.sample_time": period, "controller.delay": delay}
    assert result.growth == pytest.approx(growth_by_runs(sampled, t_end), rel=1e-3)


def test_a_long_sample_time_makes_tracking_unstable() -> None:
    results = []
    for period in (0.001, 0.1):
        result = check(load_scene("five_bar/tracking", {"controller.sample_time": period}))
        assert result.stability is not None
        assert result.stability.sampled
        assert result.stability.leaves_out == ()
        results.append((result.stability.stable, any("desired motion as sampled" in x for x in result.warnings)))
    assert results == [(True, False), (False, True)]
