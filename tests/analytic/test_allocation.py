"""How motors share a force: against every choice of motors at their limits, and SciPy's linear programs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog, lsq_linear

from ckc_pin.native.control import allocate
from tests.conftest import assert_close

Array = np.ndarray


def nearest(T: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array | None:
    """The best of all tau that have some motors at a limit and share the rest by the weighted pseudoinverse."""
    best, least = None, np.inf
    choices = [(-1, 0, 1) if np.isfinite(x) else (0,) for x in limit]
    for signs in product(*choices):
        free = np.array(signs) == 0
        tau = np.where(free, preload, np.array(signs) * np.where(free, 0.0, limit))
        scale = 1 / np.sqrt(weights[free])
        tau[free] += scale * (np.linalg.pinv(T[:, free] * scale, rcond=1e-10) @ (u - T @ tau))
        cost = float(weights @ (tau - preload) ** 2)
        if np.abs(T @ tau - u).max() < 1e-9 and np.all(np.abs(tau) <= limit * (1 + 1e-12)) and cost < least:
            best, least = tau, cost
    return best


def problems(seed: int) -> tuple[Array, ...]:
    """T, u, limit, weights and preload; some motors do nothing, some have no limit, some u are out of reach."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 4))
    m = d + int(rng.integers(1, 4))
    T = rng.standard_normal((d, m))
    T[:, rng.random(m) < 0.15] = 0.0
    T[:, :d] += 2 * np.eye(d)
    limit = 10.0 ** rng.uniform(-0.5, 0.5, m)
    limit[rng.random(m) < 0.2] = np.inf
    u = T @ np.clip(2 * rng.standard_normal(m), -limit, limit) * rng.uniform(0.5, 1.6)
    return T, u, limit, 10.0 ** rng.uniform(-1, 1, m), rng.standard_normal(m) * (seed % 2)


def feasible(T: Array, u: Array, limit: Array) -> bool:
    bounds = [(-x, x) if np.isfinite(x) else (None, None) for x in limit]
    return bool(linprog(np.zeros(len(limit)), A_eq=T, b_eq=u, bounds=bounds, method="highs").status == 0)


def at_a_price(T: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """The tau within limits with the least sum weights (tau - preload)^2 + |T tau - u|^2 / give, rows of one size."""
    rows = 1 / np.linalg.norm(T, axis=1)
    A = T * rows[:, None]
    price = 1 / np.sqrt(1e-7 * ((A**2).sum(axis=0) / weights).sum())
    left = np.vstack([price * A, np.diag(np.sqrt(weights))])
    right = np.r_[price * rows * u, np.sqrt(weights) * preload]
    return np.asarray(lsq_linear(left, right, (-limit, limit), method="bvls", tol=1e-15).x)


def test_allocation_is_the_nearest_torque_within_limits() -> None:
    kinds = {"free": 0, "limited": 0, "out of reach": 0}
    for seed in range(110):
        T, u, limit, weights, preload = problem = problems(seed)
        tau = allocate(*problem)
        alone = preload + np.linalg.pinv(T / np.sqrt(weights)) @ (u - T @ preload) / np.sqrt(weights)
        if not feasible(T, u, limit):
            kinds["out of reach"] += 1
            assert nearest(*problem) is None
            assert_close(tau, at_a_price(*problem), 1e-7 * np.abs(tau).max())
            miss = np.linalg.norm((T @ tau - u) / np.linalg.norm(T, axis=1))
            assert miss < np.linalg.norm((T @ np.clip(alone, -limit, limit) - u) / np.linalg.norm(T, axis=1)) + 1e-6
            continue
        kinds["free" if np.all(np.abs(alone) <= limit) else "limited"] += 1
        best = nearest(*problem)
        assert best is not None
        assert_close(tau, best, 1e-9)
        assert_close(T @ tau, u, 1e-11 * (1 + np.abs(u).max()))
        assert np.all(np.abs(tau) <= limit)
    assert min(kinds.values()) > 10, kinds


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_units_of_freedoms_do_not_matter(unit: float) -> None:
    """One freedom in metres or millimetres: the same torques."""
    T, u, limit, weights, preload = problems(11)
    rows = np.array([unit, *np.ones(len(u) - 1)])
    again = allocate(T * rows[:, None], u * rows, limit, weights, preload)
    assert_close(again, allocate(T, u, limit, weights, preload), 1e-11)


def test_a_preload_is_its_projection_on_the_null_space() -> None:
    T = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    endless, same = np.full(3, np.inf), np.ones(3)
    tau = allocate(T, np.array([4.0, 6.0]), endless, same, np.array([5.0, -1.0, 7.0]))
    assert_close(tau, [2.0 + 3.0, 2.0 - 3.0, 3.0], 1e-14)
    weighted = allocate(T, np.array([4.0, 6.0]), endless, np.array([1.0, 3.0, 1.0]), np.zeros(3))
    assert_close(weighted, [3.0, 1.0, 3.0], 1e-14)


def test_allocation_is_continuous_where_u_leaves_the_reachable_set() -> None:
    """By about give times the multipliers at the edge, in what the motors do together."""
    jumps = []
    for seed in range(60):
        T, u, limit, weights, preload = problems(seed)
        bounds = [(-x, x) if np.isfinite(x) else (None, None) for x in limit]
        cost = np.r_[np.zeros(len(limit)), -1.0]
        program = linprog(cost, A_eq=np.c_[T, -u], b_eq=0 * u, bounds=[*bounds, (0, 1e3)], method="highs")
        if program.x[-1] > 999:
            continue
        before, after = (allocate(T, program.x[-1] * (1 + s) * u, limit, weights, preload) for s in (-1e-9, 1e-9))
        jumps.append(np.abs(T @ (after - before)).max() / (limit[np.isfinite(limit)].max() * np.abs(T).max()))
    assert len(jumps) > 30
    assert np.median(jumps) < 1e-5
    assert max(jumps) < 1e-3
