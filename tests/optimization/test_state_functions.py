"""Derivatives of functions of the mechanism's state, by central differences at random states of several mechanisms."""

from __future__ import annotations

from functools import cache

import casadi as cs
import numpy as np
import pytest

import ckc_pin
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.spec import LoopType
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.state_functions import ExpressionFunctions, SmallestSingularValue, StateFunctions
from tests.property.mechanisms import closed_mechanism

STEP = 1e-5


@cache
def dynamics_of(name: str) -> ReducedDynamics:
    return ReducedDynamics(ckc_pin.load(name))


def at_random(dynamics: ReducedDynamics, x: Array) -> MotionInstants:
    """Return instants at x = (q, q_dot, q_ddot, tau), each (m, 3 d + motors)."""
    d, m = dynamics.d, len(x)
    q_tree = dynamics.close(np.tile(dynamics.mechanism.q_tree, (m, 1)), x[:, :d])
    assert q_tree is not None
    return dynamics.instants(q_tree, x[:, d : 2 * d], x[:, 2 * d : 3 * d], x[:, 3 * d :])


def require_exact(dynamics: ReducedDynamics, functions: StateFunctions, seed: int) -> None:
    """Compare first and second derivatives by x with central differences of values and first derivatives."""
    random, mechanism = np.random.default_rng(seed), dynamics.mechanism
    x = np.concatenate([
        mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.01, 0.01, dynamics.d) * mechanism.size,
        random.normal(size=2 * dynamics.d + dynamics.motors),
    ])  # fmt: skip
    weights = random.normal(size=functions.values(at_random(dynamics, x[None])).shape[1])
    missing = random.normal(size=dynamics.d)

    def gradients(x: Array) -> tuple[Array, Array]:
        at = at_random(dynamics, x[None])
        by_x = dynamics.differentiate(at)
        by_state = dynamics.state_derivatives(by_x)
        return (functions.gradients(at) @ by_state)[0], by_x.force[0]

    at = at_random(dynamics, x[None])
    by_x = dynamics.differentiate(at)
    by_state = dynamics.state_derivatives(by_x)
    state_weights = np.einsum("i,mis->ms", weights, functions.gradients(at))
    hessian = dynamics.hessian(at, by_x, missing[None], state_weights)[0]
    curved, second = functions.hessian(at, weights[None])
    hessian += by_state[0, curved].T @ second[0] @ by_state[0, curved]
    first, _ = gradients(x)
    differences = np.empty_like(first)
    second_differences = np.empty_like(hessian)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = STEP
        up, down = (functions.values(at_random(dynamics, (x + sign * step)[None]))[0] for sign in (1, -1))
        differences[:, k] = (up - down) / (2 * STEP)
        (g_up, f_up), (g_down, f_down) = gradients(x + step), gradients(x - step)
        second_differences[k] = (weights @ (g_up - g_down) + missing @ (f_up - f_down)) / (2 * STEP)
    assert np.abs(first).max() > 1e-3
    assert np.abs(first - differences).max() < 1e-7 * np.abs(first).max()
    assert np.abs(hessian - second_differences).max() < 1e-6 * np.abs(hessian).max()


def expressions(dynamics: ReducedDynamics) -> ExpressionFunctions:
    """Return functions of all parts of the state, linear ones and others."""
    random = np.random.default_rng(1)
    q, v, a, tau = dynamics.state_symbols
    rows = [cs.mtimes(cs.DM(random.normal(size=(1, x.numel()))), x) for x in (q, v, a, tau)]
    rows += [cs.sumsqr(cs.sin(q)) * v[-1], a[-1] * v[0], tau[0] * v[-1] if dynamics.motors else q[0] ** 2]
    return ExpressionFunctions(dynamics, rows)


@pytest.mark.parametrize("name", ["five_bar", "three_rrr", "delta", "slider_crank", "andrews"])
def test_derivatives_of_expressions_are_exact(name: str) -> None:
    dynamics = dynamics_of(name)
    require_exact(dynamics, expressions(dynamics), 2)


@pytest.mark.parametrize(("kind", "seed"), [("point", 0), ("universal", 1), ("hinge", 0), ("cylindrical", 1)])
def test_derivatives_are_exact_in_random_mechanisms(kind: LoopType, seed: int) -> None:
    closed = next(x for k in range(50) if (x := closed_mechanism(kind, 100 * seed + k, free=False)).regular)
    dynamics = ReducedDynamics(closed.mechanism)
    require_exact(dynamics, expressions(dynamics), seed)
    require_exact(dynamics, SmallestSingularValue(dynamics), seed)


@pytest.mark.parametrize("name", ["five_bar", "three_rrr", "delta", "andrews"])
def test_derivatives_of_the_smallest_singular_value_are_exact(name: str) -> None:
    dynamics = dynamics_of(name)
    require_exact(dynamics, SmallestSingularValue(dynamics), 3)


def test_the_bound_of_the_smallest_singular_value_is_close() -> None:
    """It is below it by at most the factor (number of singular values)^(-1/50)."""
    dynamics, random = dynamics_of("delta"), np.random.default_rng(4)
    mechanism = dynamics.mechanism
    q = mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.2, 0.2, (50, 3))
    q_tree = dynamics.close(np.tile(mechanism.q_tree, (50, 1)), q)
    assert q_tree is not None
    at = dynamics.instants(q_tree, 0 * q, 0 * q, np.zeros((50, dynamics.motors)))
    bound = SmallestSingularValue(dynamics).values(at)[:, 0]
    _, J = evaluate_closure(mechanism.tree, mechanism.closure, q_tree)
    exact = np.linalg.svd(J[:, mechanism.independent_rows][:, :, mechanism.partition.z], compute_uv=False)
    assert np.all(bound <= exact[:, -1] * (1 + 1e-12))
    assert np.all(bound >= exact[:, -1] * exact.shape[1] ** (-1 / 50))
