"""Sampled closed loops: their matrix by hand, and nonlinear runs that settle or do not as the verdict says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete

from ckc_pin import Sampled, check, load_scene, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import ClosedLoop, Feedback
from ckc_pin.linear.sampled_loop import sampled_loop, sampled_motion
from ckc_pin.linear.stability import stability
from tests.analytic.five_bar import FIVE_BAR, Array, complex_step
from tests.analytic.test_stability import controlled, growth_by_runs

REST = FIVE_BAR.equilibrium()  # no u is needed there: before the first one acts there is none
TARGET = {"controller.q_d": dict(zip(("theta_1", "theta_3"), REST[[0, 2]].tolist(), strict=True))}
SURE = 2e-3  # of a factor by sample: nearer to one a run would have to be long


# --- one sample to the next ----------------------------------------------------------------------


def plant_by_hand() -> tuple[Array, Array]:
    """A and B at the equilibrium, from the appendix."""

    def rate(x: Array) -> Array:
        moved = REST + FIVE_BAR.rho(REST) @ x[:2]
        return np.concatenate([x[2:4], FIVE_BAR.acceleration(moved, x[2:4], x[4:])])

    slopes = complex_step(rate, np.zeros(6))
    return slopes[:, :4], slopes[:, 4:]


@pytest.mark.parametrize("late", [0, 1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_largest_factor_is_scipys(seed: int, late: int) -> None:
    """A zero-order hold by SciPy, a delay of whole samples as a chain of them."""
    random = np.random.default_rng(seed)
    gains, period = 10.0 ** random.uniform([0.0, -1.0], [2.0, 1.0]), 10.0 ** random.uniform(-2.5, -1.0)
    A, B, *_ = cont2discrete((*plant_by_hand(), np.eye(4), np.zeros((4, 2))), period)
    K = -np.hstack([gains[0] * np.eye(2), gains[1] * np.eye(2)])
    wanted = np.zeros((4 + 2 * late, 4 + 2 * late))
    wanted[:4, :4] = A
    if late:  # of x, then of the u that are under way, the last one asked for first
        wanted[:4, -2:], wanted[4:6, :4], wanted[6:, 4:-2] = B, K, np.eye(2 * late - 2)
    else:
        wanted += B @ K
    overrides = {**TARGET, "controller.K_P": float(gains[0]), "controller.K_V": float(gains[1])}
    found = stability(*controlled("five_bar/set_point", overrides), 1.0, sampling=(period, late * period))
    assert found.sampled
    assert found.multiplier == pytest.approx(np.abs(np.linalg.eigvals(wanted)).max(), rel=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013, 0.02, 0.027])
def test_a_sampled_set_point_is_the_matrix_of_its_samples(delay: float) -> None:
    """A nonlinear run from a little off, sample by sample, once all that acts came from samples.

    The target is the equilibrium, where no u is needed: before the first one acts there is none.
    """
    period, off, count = 0.01, 1e-5, 30
    q_d = FIVE_BAR.equilibrium()[[0, 2]]
    target = {"controller.q_d": dict(zip(("theta_1", "theta_3"), q_d.tolist(), strict=True))}
    mechanism, law = controlled("five_bar/set_point", target)
    start = {"q": dict(zip(mechanism.independent, (q_d + off * np.array([1, -0.5])).tolist(), strict=True))}
    q_tree = sigma(mechanism, law.q_d).at
    loop = ClosedLoop(mechanism, law).at(0.0, Terms(mechanism, q_tree, np.zeros(mechanism.n)))
    matrix = sampled_loop(loop, period, delay)

    m = int(np.floor(delay / period + 1e-9))
    overrides = {**target, "initial": start, "t_end": count * period, "solver.output_dt": period, "solver.rtol": 1e-12,
               "formulation": "reduced"}  # fmt: skip
    run = simulate("five_bar/set_point", overrides, controller=Sampled(law, period, delay))
    at = m + 1 if delay else 0  # from here on what is under way came from samples
    x = np.hstack([run.q_tree[:, [0, 2]] - q_d, run.v_tree[:, [0, 2]]])
    under_way = (len(matrix) - 4) // 2
    y = np.concatenate([x[at], *(loop.K @ x[at - k] if at >= k else np.zeros(2) for k in range(1, under_way + 1))])
    size = np.abs(x[at:]).max()
    for k in range(at, count + 1):
        assert np.abs(y[:4] - x[k]).max() <= 2e-3 * size
        y = matrix @ y


@pytest.mark.parametrize("seed", range(8))
def test_a_run_settles_or_not_as_the_verdict_says(seed: int) -> None:
    """At random gains, sample time and delay, from a little off; what is certain to first order alone."""
    random = np.random.default_rng(seed)
    while True:
        K_P, K_V, period = (float(10.0**x) for x in random.uniform([0.0, -1.0, -2.5], [2.0, 1.0, -1.0]))
        controller = {"controller.K_P": K_P, "controller.K_V": K_V, "controller.sample_time": period,
                      "controller.delay": float(random.choice([0.0, 0.4, 1.3])) * period}  # fmt: skip
        found = check(load_scene("five_bar/set_point", {**TARGET, **controller})).stability
        assert found is not None
        assert found.multiplier is not None
        if abs(np.log(found.multiplier)) > SURE:
            break
    samples = int(np.ceil(7.0 / abs(np.log(found.multiplier)))) + 3
    off = dict(zip(("theta_1", "theta_3"), (REST[[0, 2]] + 1e-6 * random.uniform(-1, 1, 2)).tolist(), strict=True))
    start = {"initial": {"q": off}, "formulation": "reduced", "t_end": samples * period, "solver.rtol": 1e-10,
             "solver.output_dt": period, "solver.atol": 1e-14}  # fmt: skip
    run = simulate("five_bar/set_point", {**TARGET, **controller, **start})
    error = np.abs(run.q_tree[:, [0, 2]] - REST[[0, 2]]).max(axis=1)
    assert run.status == "done"
    assert found.stable == (found.multiplier < 1.0)
    if found.stable:
        assert error[-1] < 0.1 * error[0]
    else:
        assert error[-1] > 10 * error[0]


def test_sampling_too_seldom_is_unstable() -> None:
    verdicts = []
    for period in (0.02, 0.2):
        scene = load_scene("five_bar/set_point", {"controller.sample_time": period})
        found = check(scene)
        assert found.stability is not None
        assert found.stability.leaves_out == ()
        assert found.stability.eigenvalues is not None
        assert found.stability.eigenvalues.real.max() < 0
        verdicts.append((found.stability.stable, any("unstable as sampled" in x for x in found.warnings)))
    assert verdicts == [(True, False), (False, True)]


# --- along a motion ------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.024])
def test_along_a_motion_that_does_not_change_it_is_the_matrix(delay: float) -> None:
    random, period = np.random.default_rng(1), 0.01
    loop = Feedback(*(random.uniform(-1, 1, size) for size in ((4, 4), (4, 2), (2, 4))))
    start, matrix = random.uniform(-1, 1, (4, 2)), sampled_loop(loop, period, delay)
    found = sampled_motion([loop] * 7, 5 * period, start, period, delay)
    state = np.vstack([start, np.zeros((len(matrix) - 4, 2))])
    assert len(found) == 8
    for k, (x, log) in enumerate(found):
        assert np.abs(np.exp(log) * x - state[:4]).max() <= 1e-9 * np.abs(state).max(), k
        state = np.linalg.matrix_power(matrix, 5) @ state


@pytest.mark.parametrize(("period", "delay"), [(1e-3, 0.0), (1e-3, 4e-4), (5e-4, 12e-4)])
def test_growth_of_sampled_tracking_is_what_runs_do(period: float, delay: float) -> None:
    """Up to how far the sampled motion is from the desired one, which both runs share."""
    t_end = 1.5
    found = stability(*controlled("five_bar/tracking"), t_end, sampling=(period, delay))
    assert found.sampled
    sampled = {"controller.sample_time": period, "controller.delay": delay}
    assert found.growth == pytest.approx(growth_by_runs(sampled, t_end), rel=1e-3)


def test_tracking_that_is_sampled_too_seldom_is_unstable() -> None:
    verdicts = []
    for period in (0.001, 0.1):
        found = check(load_scene("five_bar/tracking", {"controller.sample_time": period}))
        assert found.stability is not None
        assert found.stability.sampled
        assert found.stability.leaves_out == ()
        verdicts.append((found.stability.stable, any("desired motion as sampled" in x for x in found.warnings)))
    assert verdicts == [(True, False), (False, True)]
