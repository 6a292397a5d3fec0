"""Exact derivatives of eq. 1 against extrapolated differences of the NumPy reference, at random states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import load, simulate
from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native.plant import Plant
from ckc_pin.scene.names import list_catalogue
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.native.loops import start_loop

SHIPPED = [name for name, *_ in list_catalogue()]
MAX_EXTRAPOLATION_ERROR = 1e-6  # relative to the largest; differences are too inaccurate next to a loss of rank


def extrapolate_derivative(function: Any, h: float) -> Any:
    """Return the derivative at zero by extrapolated central differences at h, h/2 and h/4, and an error estimate."""
    one, two, four = ((function(x) - function(-x)) / (2 * x) for x in (h, h / 2, h / 4))
    first, second = (4 * two - one) / 3, (4 * four - two) / 3
    return (16 * second - first) / 15, np.abs(second - first).max()


def largest_error(mechanism: Mechanism, random: Any) -> float:
    """Return the largest relative error of directional derivatives, for random motions of the closed loops."""
    n, tree = mechanism.n, mechanism.tree
    J = mechanism.assembled.J
    project = (
        np.eye(n) - np.linalg.pinv(J, rcond=1e-9) @ J
    )  # redundant rows contradict each other off the constraint manifold
    v, u = project @ random.uniform(-1, 1, n), random.uniform(-1, 1, n)
    derivatives = Plant(mechanism).at(Terms(mechanism, mechanism.assembled, v), u)
    worst = 0.0
    for _ in range(3):
        dq, dv, du = project @ random.uniform(-1, 1, n), project @ random.uniform(-1, 1, n), random.uniform(-1, 1, n)

        def moved(h: float, dq: Any = dq, dv: Any = dv, du: Any = du) -> Any:
            at = mechanism.kinematics(tree.integrate(mechanism.q_tree, h * dq))
            return dae_acceleration(Terms(mechanism, at, v + h * dv), u + h * du)

        expected, uncertainty = extrapolate_derivative(moved, 4e-3)
        size = np.abs(expected).max()
        if uncertainty > MAX_EXTRAPOLATION_ERROR * size:
            continue
        ours = derivatives.a_q @ dq + derivatives.a_v @ dv + derivatives.a_u @ du
        worst = max(worst, float(np.abs(ours - expected).max() / size))
    return worst


@pytest.mark.parametrize("name", SHIPPED)
def test_derivatives_of_the_acceleration_are_exact(name: str) -> None:
    assert largest_error(load(name), np.random.default_rng(0)) <= 1e-10


@pytest.mark.parametrize("seeds", [range(0, 15), range(15, 30), range(30, 45)], ids=str)
def test_derivatives_of_random_mechanisms_are_exact(seeds: range, tmp_path: Path) -> None:
    """The mechanisms have all types of loops, springs, dampers and free roots."""
    tested = 0
    for seed in seeds:
        try:
            mechanism = load(str(random_mechanism(seed).write(tmp_path / str(seed))))
        except CkcError:
            continue
        tested += 1
        assert largest_error(mechanism, np.random.default_rng(seed)) <= 2e-8, seed
    assert tested >= 10


SPF = {"formulation": "spf", "initial.w": [0.01, -0.02], "epsilon": 1e-2}
STATES = [
    ("five_bar/tracking", {"formulation": "dae"}),
    ("five_bar/tracking", {"formulation": "reduced"}),
    ("five_bar/tracking", SPF),
    ("five_bar/set_point", {"formulation": "reduced"}),
    ("five_bar/swing", {"formulation": "dae", "solver.baumgarte": [5.0, 5.0], "solver.projection": False}),
    ("flyball/default", {"formulation": "reduced"}),
    ("talos/squat", {"formulation": "dae"}),
    ("three_rrr/circle", {"formulation": "reduced"}),
    ("delta/default", {"formulation": "reduced"}),
    ("two_ur5/default", {"formulation": "dae"}),
    ("two_ur5/lift", {"formulation": "dae"}),
    ("two_ur5/lift", {"formulation": "reduced"}),
    ("stewart/default", {"formulation": "reduced"}),
]


@pytest.mark.parametrize(
    ("scene", "overrides"), STATES, ids=lambda x: x if isinstance(x, str) else x.get("formulation")
)
def test_jacobians_of_right_hand_sides_are_exact(scene: str, overrides: dict[str, Any]) -> None:
    """With Pinocchio's terms and with controllers, in directions that keep the loops closed, at states in motion."""
    ready = start_loop(scene, {**overrides, "solver.terms": "pinocchio", "solver.rtol": 1e-12})
    loop, mechanism, random = ready.loop, ready.mechanism, np.random.default_rng(3)
    n, tree, d = mechanism.n, mechanism.tree, mechanism.d
    reduced = len(loop.y) == 2 * d
    y = loop.y.copy()
    J = ready.start.at.J
    project = np.eye(n) - np.linalg.pinv(J, rcond=1e-9) @ J
    y[-(d if reduced else n) :] += 0.3 * (random.uniform(-1, 1, d) if reduced else project @ random.uniform(-1, 1, n))
    t, derivatives, before = 0.1, loop.jacobian(0.1, y), loop.stats().differences
    assert before == 0
    for _ in range(3):
        if reduced:
            change = random.uniform(-1, 1, 2 * d)

            def moved(h: float, change: Any = change) -> Any:
                return loop.rhs(t, y + h * change)
        else:
            dq, dv = project @ random.uniform(-1, 1, n), project @ random.uniform(-1, 1, n)
            change = np.concatenate([tree.configuration_rate(y[: tree.nq], dq), dv])

            def moved(h: float, dq: Any = dq, dv: Any = dv) -> Any:
                return loop.rhs(t, np.concatenate([tree.integrate(y[: tree.nq], h * dq), y[tree.nq :] + h * dv]))

        expected, _ = extrapolate_derivative(moved, 2e-3)
        assert np.abs(derivatives @ change - expected).max() <= 1e-8 * np.abs(expected).max()


def test_only_user_controllers_are_differentiated_by_differences() -> None:
    class UserController:
        def u(self, t: float, terms: Any) -> Any:
            return -3.0 * terms.q_dot

    overrides = {"formulation": "reduced", "solver.method": "Radau", "solver.rtol": 1e-6, "t_end": 0.5}
    theirs = simulate("five_bar/swing", overrides, controller=UserController()).stats
    assert theirs["differences"] == theirs["jacobians"] > 0
    ours = simulate("five_bar/tracking", overrides).stats
    assert ours["differences"] == 0 < ours["jacobians"]
