"""The fastest speed along a path, against linear programs of SciPy (HiGHS) and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import lil_matrix

from ckc_pin.base.arrays import Array
from ckc_pin.optimization.speed_profile import Blocked, SpeedProfile, SpeedRows, estimate_slopes, fastest_profile

LARGEST = 50.0  # of s_dot^2


def random_rows(seed: int, s: Array, motors: int) -> SpeedRows:
    """Return limits of motors on a random robot: |a1 u + a2 b + a3| <= 1."""
    random = np.random.default_rng(seed)
    phase, frequency = random.uniform(0, 6, motors), random.uniform(1, 6, motors)
    angle = np.outer(s, frequency) + phase
    a1 = (1 + 0.5 * np.sin(angle)) * random.choice([-1, 1], motors)
    a2, a3 = 2 * np.sin(2 * angle), 0.5 * np.cos(angle)
    return SpeedRows(np.hstack([a1, -a1]), np.hstack([a2, -a2]), np.hstack([1 - a3, 1 + a3]), np.full(len(s), LARGEST))


def linear_program(s: Array, rows: SpeedRows, slopes: Array) -> Array:
    """Return the largest b by a sparse linear program. The maximum of the sum is the maximum at each point."""
    step, count = np.diff(s), len(s)
    matrix, right = lil_matrix((2 * len(step) * rows.alpha.shape[1], count)), []
    line = 0
    for k, h in enumerate(step):
        for at, off in ((k, -h / 2), (k + 1, h / 2)):
            for alpha, beta, gamma in zip(rows.alpha[at], rows.beta[at], rows.gamma[at], strict=True):
                # alpha (u + slope off) + beta b <= gamma, with u = (b[k + 1] - b[k]) / (2 h)
                matrix[line, k + 1] += alpha / (2 * h)
                matrix[line, k] -= alpha / (2 * h)
                matrix[line, at] += beta
                right.append(gamma - alpha * slopes[k] * off)
                line += 1
    bounds = [(0, 0), *[(0, LARGEST)] * (count - 2), (0, 0)]
    result = linprog(-np.ones(count), A_ub=matrix.tocsr(), b_ub=right, bounds=bounds)
    assert result.status == 0
    return np.asarray(result.x)


@pytest.mark.parametrize("seed", range(6))
def test_sweeps_equal_a_linear_program(seed: int) -> None:
    s = np.sort(np.concatenate([[0, 1], np.random.default_rng(seed).uniform(0.01, 0.99, 150)]))
    rows = random_rows(seed, s, 3)
    none = np.zeros(len(s) - 1)
    profile = fastest_profile(s, rows, 0.0, 0.0)
    assert not isinstance(profile, Blocked)
    assert np.abs(profile - linear_program(s, rows, none)).max() < 1e-9
    slopes = estimate_slopes(s, profile)
    steeper = fastest_profile(s, rows, 0.0, 0.0, slopes)
    assert not isinstance(steeper, Blocked)
    assert np.abs(steeper - linear_program(s, rows, slopes)).max() < 1e-9


def test_many_rows_equal_a_linear_program() -> None:
    s = np.linspace(0, 1, 40)
    rows = random_rows(7, s, 60)
    profile = fastest_profile(s, rows, 0.0, 0.0)
    assert not isinstance(profile, Blocked)
    assert np.abs(profile - linear_program(s, rows, np.zeros(39))).max() < 1e-6


def test_double_integrator_takes_twice_the_root_of_the_distance() -> None:
    s, one = np.linspace(0, 1, 101), np.ones((101, 1))
    rows = SpeedRows(np.hstack([one, -one]), np.zeros((101, 2)), np.ones((101, 2)), np.full(101, 100.0))
    b = fastest_profile(s, rows, 0.0, 0.0)
    assert not isinstance(b, Blocked)
    assert abs(SpeedProfile(s, b, np.zeros(100)).t[-1] - 2.0) < 1e-12


def test_a_limit_that_no_speed_fulfils_is_named_with_its_interval() -> None:
    s, one = np.linspace(0, 1, 11), np.ones((11, 1))
    gamma = np.ones((11, 2))
    gamma[6, 0] = -2.0  # u <= -2 and u >= -1
    result = fastest_profile(
        s, SpeedRows(np.hstack([one, -one]), np.zeros((11, 2)), gamma, np.full(11, 100.0)), 0.0, 0.0
    )
    assert isinstance(result, Blocked)
    assert result.interval in (5, 6)


@pytest.mark.parametrize("slope", [-3.0, 0.0, 2.0])
def test_motion_with_linear_acceleration_solves_its_differential_equation(slope: float) -> None:
    s = np.linspace(0, 1, 6)
    b = np.array([0.0, 0.5, 1.0, 1.2, 0.7, 0.0])
    profile = SpeedProfile(s, b, np.full(5, slope))
    t = np.linspace(0, profile.t[-1], 4001)
    position, speed, acceleration = profile(t)
    assert np.abs(np.gradient(position, t)[5:-5] - speed[5:-5]).max() < 1e-3
    inside = (np.searchsorted(profile.t, t[1:-1]) == np.searchsorted(profile.t, t[2:])) & (
        np.searchsorted(profile.t, t[:-2]) == np.searchsorted(profile.t, t[1:-1])
    )
    difference = (speed[2:] - speed[:-2]) / (t[2:] - t[:-2])
    assert np.abs(difference - acceleration[1:-1])[inside].max() < 1e-4
    assert np.allclose(profile(profile.t)[0], s, rtol=0, atol=1e-14)
