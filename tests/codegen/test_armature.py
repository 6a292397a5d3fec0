"""Rotor inertia at the five-bar's joints: every term and formulation against the appendix in NumPy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Mechanism, as_ivp, load, simulate, symbolic, terms
from ckc_pin.codegen.library import compile_terms
from ckc_pin.dynamics import dae_acceleration, reduced_acceleration
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from tests.analytic.five_bar import FIVE_BAR, Array, E, FiveBar
from tests.conftest import assert_close

EXACT = 1e-12
NAMES = ("theta_1", "theta_2", "theta_3", "theta_4")
START = np.array([-1.1, -2.0])


@dataclass(frozen=True)
class Geared(FiveBar):
    """A five-bar with rotors at its joints; inertias in kg m^2 as seen from the joint."""

    rotors: tuple[float, ...] = (0.03, 0.008, 0.05, 0.002)

    def D_tree(self, q_tree: Array) -> Array:
        """Return D' of eq. 24 plus the rotors' inertia, (4, 4)."""
        return super().D_tree(q_tree) + np.diag(self.rotors)


GEARED = Geared(**asdict(FIVE_BAR))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("geared")
    for name, text in load("five_bar").sources.texts.items():
        (folder / name).write_text(text)
    tables = (f'[[joint]]\nname = "{n}"\narmature = {x}\n' for n, x in zip(NAMES, GEARED.rotors, strict=True))
    with (folder / "mechanism.toml").open("a") as file:
        file.write("\n" + "".join(tables))
    initial = f"[initial.q]\ntheta_1 = {START[0]}\ntheta_3 = {START[1]}\n"
    (folder / "default.scene.toml").write_text(
        f'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n{initial}[solver]\nrtol = 1e-11\n'
    )
    return folder


@pytest.fixture(scope="module")
def mechanism(folder: Path) -> Mechanism:
    return load(folder)


def states() -> list[tuple[Array, Array, Array]]:
    """Return closed configurations, velocities q_dot and torques."""
    random, samples = np.random.default_rng(11), []
    for _ in range(20):
        q_tree = GEARED.sigma(np.array([-1.4, -1.7]) + random.uniform(-0.4, 0.4, 2))
        samples.append((q_tree, random.uniform(-3, 3, 2), random.uniform(-2, 2, 2)))
    return samples


def test_terms_include_rotor_inertia(mechanism: Mechanism) -> None:
    for q_tree, q_dot, _ in states():
        v_tree = GEARED.rho(q_tree) @ q_dot
        ours = terms(mechanism, dict(zip(NAMES, q_tree, strict=True)), dict(zip(NAMES, v_tree, strict=True)))
        assert_close(ours.D_tree, GEARED.D_tree(q_tree), EXACT)
        assert_close(ours.D, GEARED.D(q_tree), EXACT)
        assert_close(ours.C_times(q_dot), GEARED.C(q_tree, v_tree) @ q_dot, 1e-11)
        assert_close(ours.bias_tree, GEARED.C_tree(q_tree, v_tree) @ v_tree + GEARED.h_tree(q_tree), 1e-11)
        assert_close(ours.energy, GEARED.energy(q_tree, v_tree), 1e-11)


def test_accelerations_include_rotor_inertia(mechanism: Mechanism) -> None:
    """In NumPy, in C++ with Pinocchio's and with compiled terms, and by CasADi."""
    cores = [_core.Core(core_table(mechanism)), _core.Core(core_table(mechanism, compile_terms(mechanism)))]
    expressions = symbolic(mechanism)
    for q_tree, q_dot, u in states():
        v_tree = GEARED.rho(q_tree) @ q_dot
        expected, _ = GEARED.acceleration_and_multipliers(q_tree, v_tree, u)
        tolerance = 1e-10 * np.abs(expected).max()
        at = terms(mechanism, dict(zip(NAMES, q_tree, strict=True)), dict(zip(NAMES, v_tree, strict=True)))
        assert_close(dae_acceleration(at, E @ u), expected, tolerance)
        assert_close(reduced_acceleration(at, E @ u), expected[[0, 2]], tolerance)
        for core in cores:
            assert_close(core.dae_acceleration(q_tree, v_tree, E @ u, np.zeros(2)), expected, tolerance)
            assert_close(core.reduced_acceleration(q_tree, q_dot, v_tree, E @ u, False), expected[[0, 2]], tolerance)
            assert_close(core.terms(q_tree, v_tree)["D_tree"], GEARED.D_tree(q_tree), EXACT)
        v_dot = expressions.v_dot(q_tree, v_tree, E @ u, expressions.values)
        assert_close(v_dot.full()[:, 0], expected, tolerance)
        kinetic = v_tree @ GEARED.D_tree(q_tree) @ v_tree / 2
        assert_close(float(expressions.kinetic(q_tree, v_tree, expressions.values)), kinetic, EXACT * max(1, kinetic))


def integrate_appendix(five_bar: FiveBar) -> Array:
    """Return q and q_dot at t = 1 s, by the appendix and SciPy."""

    def f(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], five_bar.acceleration(five_bar.sigma(y[:2]), y[2:], np.zeros(2))])

    start = np.concatenate([START, np.zeros(2)])
    return solve_ivp(f, (0.0, 1.0), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.fixture(scope="module")
def end_of_swing() -> Array:
    """Return q and q_dot at t = 1 s with rotors, which differ from those without."""
    end = integrate_appendix(GEARED)
    assert np.abs(integrate_appendix(FIVE_BAR) - end).max() > 0.1
    return end


@pytest.mark.parametrize("generated", [False, True])
@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_swing_with_rotors_is_that_of_the_appendix(
    formulation: str, generated: bool, folder: Path, end_of_swing: Array
) -> None:
    whose = "generated" if generated else "pinocchio"
    run = simulate(folder, {"formulation": formulation, "solver.terms": whose})
    assert run.stats["terms"] == whose
    assert_close(run.q_tree[-1][[0, 2]], end_of_swing[:2], 1e-8)
    assert_close(run.v_tree[-1][[0, 2]], end_of_swing[2:], 1e-8)
    assert_close(run.energy, GEARED.energy(GEARED.sigma(START), np.zeros(4)), 1e-9)


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_reference_formulations_include_rotor_inertia(formulation: str, folder: Path, end_of_swing: Array) -> None:
    problem = as_ivp(folder, {"formulation": formulation})
    solution = solve_ivp(problem.f, problem.t_span, problem.y0, "DOP853", rtol=1e-10, atol=1e-12)
    at = problem.terms(1.0, solution.y[:, -1])
    assert_close(at.q, end_of_swing[:2], 1e-8)
    assert_close(at.q_dot, end_of_swing[2:], 1e-8)
