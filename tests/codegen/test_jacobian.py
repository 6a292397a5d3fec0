"""Exact Jacobians of right-hand sides: against the appendix by complex steps, and against differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import load, simulate
from ckc_pin.codegen.library import compile_terms
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.analytic.five_bar import FIVE_BAR
from tests.codegen.test_compiled import COUPLED, FREE
from tests.native.loops import start_loop

STEP = 1e-30  # of a complex step, which has no cancellation
K_P, K_V = 30.0, 4.0


def five_bar(formulation: str, controlled: bool) -> Any:
    overrides: dict[str, Any] = {"formulation": formulation, "solver.terms": "generated", "solver.rtol": 1e-12}
    if controlled:
        overrides["controller"] = {
            "type": "set_point",
            "K_P": K_P,
            "K_V": K_V,
            "q_d": {"theta_1": -1.2, "theta_3": -1.6},
        }
    return start_loop("five_bar/swing", overrides).loop


def control(controlled: bool, q: Any, q_dot: Any) -> Any:
    """Return the part of eq. 14's torque that depends on the state."""
    return -K_P * q - K_V * q_dot if controlled else np.zeros(2)


@pytest.mark.parametrize("controlled", [False, True])
def test_jacobian_of_the_dae_is_that_of_the_appendix(controlled: bool) -> None:
    """At states on and off the manifold."""
    loop, random = five_bar("dae", controlled), np.random.default_rng(0)
    here = loop.y[:4]
    for _ in range(20):
        y = np.concatenate([here + random.uniform(-0.3, 0.3, 4), random.uniform(-3, 3, 4)])
        rate = loop.rhs(0.0, y)
        # u follows from the acceleration, which is linear in it
        D, J = FIVE_BAR.D_tree(y[:4]), FIVE_BAR.J(y[:4])
        u = _applied(D, J, rate[4:] - FIVE_BAR.acceleration_and_multipliers(y[:4], y[4:], np.zeros(2))[0])
        expected = np.zeros((8, 8))
        expected[:4, 4:] = np.eye(4)
        for k in range(8):
            moved = y + 1j * STEP * np.eye(8)[k]
            change = control(controlled, moved[[0, 2]], moved[[4, 6]]) - control(controlled, y[[0, 2]], y[[4, 6]])
            expected[4:, k] = FIVE_BAR.acceleration_and_multipliers(moved[:4], moved[4:], u + change)[0].imag / STEP
        assert np.abs(loop.jacobian(0.0, y) - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("controlled", [False, True])
def test_jacobian_of_the_reduced_model_is_that_of_the_appendix(controlled: bool) -> None:
    loop, random = five_bar("reduced", controlled), np.random.default_rng(1)
    start = loop.y[:2]
    for _ in range(20):
        y = np.concatenate([start + random.uniform(-0.2, 0.2, 2), random.uniform(-3, 3, 2)])
        here = FIVE_BAR.sigma(y[:2])
        u = FIVE_BAR.D(here) @ (loop.rhs(0.0, y)[2:] - FIVE_BAR.acceleration(here, y[2:], np.zeros(2)))
        expected = np.zeros((4, 4))
        expected[:2, 2:] = np.eye(2)
        for k in range(4):
            dq, dv = 1j * STEP * np.eye(4)[k, :2], 1j * STEP * np.eye(4)[k, 2:]
            change = control(controlled, dq, dv)
            moved = here + FIVE_BAR.rho(here) @ dq  # to first order, which a complex step makes exact
            expected[2:, k] = FIVE_BAR.acceleration(moved, y[2:] + dv, u + change).imag / STEP
        assert np.abs(loop.jacobian(0.0, y) - expected).max() <= 1e-10 * np.abs(expected).max()


def _applied(D: Any, J: Any, a: Any) -> Any:
    """Return the torques at theta_1 and theta_3 that add a to the acceleration."""
    inverse = np.linalg.inv(np.block([[D, -J.T], [J, np.zeros((2, 2))]]))[:4, :4]
    return np.linalg.lstsq(inverse[:, [0, 2]], a, rcond=None)[0]


@pytest.mark.parametrize("name", ["bricard", "flyball", FREE, COUPLED])
def test_jacobians_of_other_daes_agree_with_differences(name: str | int, tmp_path: Path) -> None:
    """The differences are extrapolated and central, of the general core, along motions that keep quaternions' norms."""
    folder = name if isinstance(name, str) else str(random_mechanism(name).write(tmp_path / "mechanism"))
    mechanism = load(folder)
    compile_terms(mechanism)
    tree, random = mechanism.tree, np.random.default_rng(2)
    ours, theirs = (dae(folder, terms, tmp_path) for terms in ("generated", "pinocchio"))
    J = mechanism.assembled.J
    free = np.eye(tree.n) - np.linalg.pinv(J, rcond=1e-9) @ J
    v = free @ random.uniform(-1, 1, tree.n)  # redundant rows contradict each other off the manifold
    compiled, general = (loop.jacobian(0.0, np.concatenate([mechanism.q_tree, v])) for loop in (ours, theirs))
    for _ in range(6):
        step, dv = free @ random.uniform(-1, 1, tree.n), free @ random.uniform(-1, 1, tree.n)

        def difference(h: float, step: Any = step, dv: Any = dv) -> Any:
            forward, backward = (
                theirs.rhs(0.0, np.concatenate([tree.integrate(mechanism.q_tree, s * h * step), v + s * h * dv]))
                for s in (1, -1)
            )
            return (forward - backward) / (2 * h)

        h = 4e-3
        one, two, four = difference(h), difference(h / 2), difference(h / 4)
        first, second = (4 * two - one) / 3, (4 * four - two) / 3
        expected = (16 * second - first) / 15
        along = np.concatenate([tree.configuration_rate(mechanism.q_tree, step), dv])
        assert np.abs(compiled @ along - general @ along).max() <= 1e-11 * np.abs(expected).max()
        assert np.abs(compiled @ along - expected).max() <= 1e-8 * np.abs(expected).max()


def dae(mechanism: str, terms: str, folder: Path) -> Any:
    scene = folder / f"{terms}.scene.toml"
    text = f'mechanism = "{mechanism}"\nformulation = "dae"\nt_end = 1.0\ninitial.at = "assembled"\n'
    scene.write_text(text + f'solver.terms = "{terms}"\n')
    return start_loop(str(scene)).loop


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_exact_jacobians_cost_no_right_hand_sides(formulation: str) -> None:
    overrides = {"formulation": formulation, "solver.method": "Radau", "solver.rtol": 1e-6, "t_end": 1.0}
    ours, theirs = (simulate("five_bar/swing", {**overrides, "solver.terms": x}) for x in ("generated", "pinocchio"))
    assert ours.stats["jacobians"] == theirs.stats["jacobians"] > 0
    assert np.abs(ours.q_tree[-1] - theirs.q_tree[-1]).max() < 1e-5
    assert ours.stats["differences"] == theirs.stats["differences"] == 0
    assert ours.stats["rhs"] == pytest.approx(
        theirs.stats["rhs"], rel=0.02
    )  # the general core's Jacobians are exact too
