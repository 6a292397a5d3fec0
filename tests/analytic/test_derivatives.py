"""Derivatives of eq. 1 against differences with forty digits of an independent model."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from ckc_pin import Mechanism, load
from ckc_pin.codegen.library import compile_terms
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.rows import log_jacobian, log_jacobian_dot
from ckc_pin.mechanism.spec import LoopType
from ckc_pin.native import _core
from ckc_pin.native.plant import Plant
from tests.analytic.many_digits import ManyDigits, exact, log, rotation_of
from tests.analytic.small_models import coupled_four_bar, plate_on_springs
from tests.property.mechanisms import closed_mechanism

TOLERANCE = 1e-10  # relative


def assert_derivatives_agree(terms: Terms, random: np.random.Generator, plant: Plant | None = None) -> None:
    """Compare directional derivatives for a random direction of configuration, velocity and force."""
    mechanism = terms.mechanism
    u_tree, steps = random.uniform(-5, 5, mechanism.n), random.uniform(-1, 1, (3, mechanism.n))
    derivatives = (plant or Plant(mechanism)).at(terms, u_tree)
    theirs = ManyDigits(mechanism).differentiate(terms.q_tree, terms.v_tree, u_tree, (steps[0], steps[1], steps[2]))
    a = derivatives.a_q @ steps[0] + derivatives.a_v @ steps[1] + derivatives.a_u @ steps[2]
    forces = (
        derivatives.multipliers_q @ steps[0]
        + derivatives.multipliers_v @ steps[1]
        + derivatives.multipliers_u @ steps[2]
    )
    for ours, expected in zip((a, forces), theirs, strict=True):
        assert np.abs(ours - expected).max() <= TOLERANCE * np.abs(expected).max()


def random_state(mechanism: Mechanism, random: np.random.Generator, spread: float) -> Terms:
    """Return a random state off the constraint manifold."""
    q_tree = mechanism.tree.integrate(mechanism.q_tree, random.uniform(-spread, spread, mechanism.n))
    return Terms(mechanism, mechanism.kinematics(q_tree), random.uniform(-2, 2, mechanism.n))


@pytest.mark.parametrize("kind", get_args(LoopType))
def test_every_kind_of_loop(kind: LoopType) -> None:
    """The mechanism has a free root, prismatic and revolute joints, a coupling, springs, dampers and rotors."""
    world = next(x for seed in range(20) if (x := closed_mechanism(kind, seed)).regular)
    assert_derivatives_agree(world.random_state(), np.random.default_rng(1))
    assert_derivatives_agree(random_state(world.mechanism, np.random.default_rng(2), 0.05), np.random.default_rng(3))


def test_nonlinear_couplings() -> None:
    """Three joints in one coupling, a polynomial and a table; with compiled terms too."""
    world = next(x for seed in range(20) if (x := closed_mechanism("point_2d", seed, nonlinear=True)).regular)
    state, random = world.random_state(), np.random.default_rng(1)
    assert_derivatives_agree(state, random)
    assert_derivatives_agree(state, random, Plant(world.mechanism, library=compile_terms(world.mechanism)))
    assert_derivatives_agree(random_state(world.mechanism, np.random.default_rng(2), 0.05), np.random.default_rng(3))


@pytest.mark.parametrize("seed", range(3))
def test_the_five_bar(seed: int) -> None:
    mechanism, random = load("five_bar"), np.random.default_rng(seed)
    at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.3, 0.3, 2)).at
    state = Terms(mechanism, at, at.rho @ random.uniform(-3, 3, 2))
    assert_derivatives_agree(state, random)
    assert_derivatives_agree(state, random, Plant(mechanism, library=compile_terms(mechanism)))


@pytest.mark.parametrize("make", [coupled_four_bar, plate_on_springs])
def test_loops_with_springs(make: type, tmp_path: Path) -> None:
    mechanism = make(tmp_path)
    for seed in range(3):
        assert_derivatives_agree(
            random_state(mechanism, np.random.default_rng(seed), 0.1), np.random.default_rng(seed + 9)
        )


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 9.999e-3, 1.0001e-2, 0.4, 0.999, 1.001, 2.0, 3.0])
def test_the_logarithm_of_a_rotation_differentiated_three_times(angle: float) -> None:
    """The reference is differences of the logarithm with many digits."""
    random = np.random.default_rng(0)
    u, x, y, z = random.uniform(-1, 1, (4, 3))
    u *= angle / np.linalg.norm(u)
    U, X, Y, Z = (exact(a) for a in (u, x, y, z))
    h = exact(1e-12)[()]

    def jlog(v: object) -> object:
        R = rotation_of(v)
        return (log(R @ rotation_of(h * h * X)) - log(R @ rotation_of(-h * h * X))) / (2 * h * h)

    def jlog_dot(v: object) -> object:
        return (jlog(v + h * Y) - jlog(v - h * Y)) / (2 * h)  # type: ignore[operator]

    jlog_ddot = (jlog_dot(U + h * Z) - jlog_dot(U - h * Z)) / (2 * h)
    value, differentiate, second_derivative = _core.log_jacobian(u, y, z)
    for ours, theirs in (
        (log_jacobian(u[None])[0] @ x, jlog(U)),
        (log_jacobian_dot(u[None], y[None])[0] @ x, jlog_dot(U)),
        (value @ x, jlog(U)),
        (differentiate @ x, jlog_dot(U)),
        (second_derivative @ x, jlog_ddot),
    ):
        expected = np.array(theirs, dtype=float)
        assert np.abs(ours - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())
