"""Torque allocation to redundant motors, against enumeration of motors at their limits and SciPy's linear programs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog, lsq_linear

from ckc_pin.native.control import allocate
from tests.conftest import assert_close

Array = np.ndarray


def find_best_torque(T: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array | None:
    """Return the best tau over all choices of motors at limits; the weighted pseudoinverse gives the other motors."""
    best, smallest_cost = None, np.inf
    choices = [(0, *(side for side, x in zip((-1, 1), pair, strict=True) if np.isfinite(x))) for pair in limit.T]
    for signs in product(*choices):
        free = np.array(signs) == 0
        tau = np.where(free, preload, np.where(np.array(signs) < 0, *limit))
        scale = 1 / np.sqrt(weights[free])
        tau[free] += scale * (np.linalg.pinv(T[:, free] * scale, rcond=1e-10) @ (u - T @ tau))
        cost = float(weights @ (tau - preload) ** 2)
        if np.abs(T @ tau - u).max() < 1e-9 and is_within(tau, limit) and cost < smallest_cost:
            best, smallest_cost = tau, cost
    return best


def is_within(tau: Array, limit: Array) -> bool:
    return bool(np.all((limit[0] * (1 + 1e-12) <= tau) & (tau <= limit[1] * (1 + 1e-12))))


def random_problem(seed: int) -> tuple[Array, ...]:
    """Return random T, u, limits, weights and preload.

    Some motors have no effect or no limit, some u are unreachable. Limits of every third problem have two different
    sides, some of them zero.
    """
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 4))
    m = d + int(rng.integers(1, 4))
    T = rng.standard_normal((d, m))
    T[:, rng.random(m) < 0.15] = 0.0
    T[:, :d] += 2 * np.eye(d)
    limit = 10.0 ** rng.uniform(-0.5, 0.5, m)
    limit[rng.random(m) < 0.2] = np.inf
    limits = np.array([-limit, limit])
    if seed % 3 == 0:
        sides = np.random.default_rng([seed, 1])
        finite = np.flatnonzero(np.isfinite(limit))
        limits[sides.integers(0, 2, len(finite)), finite] *= sides.choice([0.0, 0.2, 2.0], len(finite))
        limits[0, ~np.isfinite(limit)] = 0.0  # a limit on one side only
    middle = np.array([np.mean(pair[np.isfinite(pair)] if np.isfinite(pair).any() else 0.0) for pair in limits.T])
    middle += np.where(np.isfinite(limits).sum(axis=0) == 1, np.where(np.isfinite(limits[0]), 1.0, -1.0), 0.0)
    u = T @ (middle + (np.clip(2 * rng.standard_normal(m), *limits) - middle) * rng.uniform(0.5, 1.6))
    return T, u, limits, 10.0 ** rng.uniform(-1, 1, m), rng.standard_normal(m) * (seed % 2)


def is_feasible(T: Array, u: Array, limit: Array) -> bool:
    bounds = np.where(np.isfinite(limit.T), limit.T, None).tolist()
    return bool(linprog(np.zeros(limit.shape[1]), A_eq=T, b_eq=u, bounds=bounds, method="highs").status == 0)


def minimize_penalized(T: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """Return the limited tau that minimizes sum weights (tau - preload)^2 + price^2 |T tau - u|^2, T with unit rows."""
    rows = 1 / np.linalg.norm(T, axis=1)
    A = T * rows[:, None]
    price = 1 / np.sqrt(1e-7 * ((A**2).sum(axis=0) / weights).sum())
    left = np.vstack([price * A, np.diag(np.sqrt(weights))])
    right = np.r_[price * rows * u, np.sqrt(weights) * preload]
    return np.asarray(lsq_linear(left, right, tuple(limit), method="bvls", tol=1e-15).x)


def test_allocation_minimizes_the_weighted_torque_at_limits() -> None:
    kinds = {"free": 0, "limited": 0, "out of reach": 0}
    for seed in range(110):
        T, u, limit, weights, preload = problem = random_problem(seed)
        tau = allocate(*problem)
        unlimited = preload + np.linalg.pinv(T / np.sqrt(weights)) @ (u - T @ preload) / np.sqrt(weights)
        if not is_feasible(T, u, limit):
            kinds["out of reach"] += 1
            assert find_best_torque(*problem) is None
            assert_close(tau, minimize_penalized(*problem), 1e-7 * np.abs(tau).max())
            miss = np.linalg.norm((T @ tau - u) / np.linalg.norm(T, axis=1))
            assert miss < np.linalg.norm((T @ np.clip(unlimited, *limit) - u) / np.linalg.norm(T, axis=1)) + 1e-6
            continue
        kinds["free" if is_within(unlimited, limit) else "limited"] += 1
        best = find_best_torque(*problem)
        assert best is not None
        assert_close(tau, best, 1e-9)
        assert_close(T @ tau, u, 1e-11 * (1 + np.abs(u).max()))
        assert is_within(tau, limit)
    assert min(kinds.values()) > 10, kinds


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_units_of_freedoms_do_not_matter(unit: float) -> None:
    """The torques do not depend on the unit of a freedom, metres or millimetres."""
    T, u, limit, weights, preload = random_problem(11)
    rows = np.array([unit, *np.ones(len(u) - 1)])
    again = allocate(T * rows[:, None], u * rows, limit, weights, preload)
    assert_close(again, allocate(T, u, limit, weights, preload), 1e-11)


def test_a_preload_is_its_projection_on_the_null_space() -> None:
    T = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    no_limits, equal_weights = np.array([[-np.inf] * 3, [np.inf] * 3]), np.ones(3)
    tau = allocate(T, np.array([4.0, 6.0]), no_limits, equal_weights, np.array([5.0, -1.0, 7.0]))
    assert_close(tau, [2.0 + 3.0, 2.0 - 3.0, 3.0], 1e-14)
    weighted = allocate(T, np.array([4.0, 6.0]), no_limits, np.array([1.0, 3.0, 1.0]), np.zeros(3))
    assert_close(weighted, [3.0, 1.0, 3.0], 1e-14)


def test_allocation_is_continuous_where_u_leaves_the_reachable_set() -> None:
    """The jump of T tau at the edge is about the multipliers divided by the penalty."""
    jumps = []
    for seed in range(60):
        T, u, limit, weights, preload = random_problem(seed)
        bounds = np.where(np.isfinite(limit.T), limit.T, None).tolist()
        cost = np.r_[np.zeros(limit.shape[1]), -1.0]
        program = linprog(cost, A_eq=np.c_[T, -u], b_eq=0 * u, bounds=[*bounds, (0, 1e3)], method="highs")
        if program.x[-1] > 999:
            continue
        before, after = (allocate(T, program.x[-1] * (1 + s) * u, limit, weights, preload) for s in (-1e-9, 1e-9))
        jumps.append(np.abs(T @ (after - before)).max() / (np.abs(limit[np.isfinite(limit)]).max() * np.abs(T).max()))
    assert len(jumps) > 30
    assert np.median(jumps) < 1e-5
    assert max(jumps) < 1e-3
