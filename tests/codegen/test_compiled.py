"""Compiled terms against Pinocchio's terms, in the native core and along runs."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, Simulator, load, simulate
from ckc_pin.codegen.library import compile_terms
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

SIMULATE = import_module("ckc_pin.run.simulate")  # the module: `ckc_pin.run.simulate` may also be the function
SHIPPED = ["five_bar", "slider_crank_spatial", "bricard", "flyball", "andrews"]
# Seeds of random mechanisms: a free root on a damped spring; redundant rows and a coupling.
FREE, COUPLED = 18, 14


def assert_equal_terms(mechanism: Mechanism, count: int = 20) -> None:
    """Compare all terms and accelerations of two cores at random states, on the manifold and off it."""
    ours, theirs = _core.Core(core_table(mechanism, compile_terms(mechanism))), _core.Core(core_table(mechanism))
    random, n = np.random.default_rng(7), mechanism.n
    for k in range(count):
        is_closed = k % 2 == 0
        q = mechanism.q_tree
        if not is_closed:
            q = mechanism.tree.integrate(q, 0.3 * random.uniform(-1, 1, n))
        v, u = random.uniform(-2, 2, n), random.uniform(-1, 1, n)
        if is_closed:
            J = theirs.jacobian(q)
            v = v - np.linalg.pinv(J, rcond=1e-9) @ (J @ v)
        expected, compiled = theirs.terms(q, v), ours.terms(q, v)
        for name, term in expected.items():
            scale = max(1.0, float(np.abs(term).max(initial=0.0)))
            assert np.abs(np.asarray(compiled[name]) - term).max(initial=0.0) <= 1e-11 * scale, name
        if is_closed or not mechanism.redundant:
            correction = np.zeros(mechanism.closure.rows)
            acceleration = theirs.dae_acceleration(q, v, u, correction)
            error = np.abs(ours.dae_acceleration(q, v, u, correction) - acceleration).max()
            assert error <= 1e-11 * np.abs(acceleration).max()


@pytest.mark.parametrize("name", SHIPPED)
def test_compiled_terms_of_shipped_mechanisms_are_pinocchios(name: str) -> None:
    assert_equal_terms(load(name))


@pytest.mark.parametrize("seed", [FREE, COUPLED])
def test_compiled_terms_of_random_mechanisms_are_pinocchios(seed: int, tmp_path: Path) -> None:
    assert_equal_terms(load(random_mechanism(seed).write(tmp_path / "mechanism")))


def test_compiled_acceleration_is_that_of_the_appendix() -> None:
    """The reference is the five-bar in NumPy, which imports nothing of the package."""
    mechanism = load("five_bar")
    core, random = _core.Core(core_table(mechanism, compile_terms(mechanism))), np.random.default_rng(3)
    for _ in range(20):
        q = FIVE_BAR.sigma(np.array([-1.4, -1.7]) + random.uniform(-0.3, 0.3, 2))
        q_dot = random.uniform(-3, 3, 2)
        v = FIVE_BAR.rho(q) @ q_dot
        ours = core.dae_acceleration(q, v, np.zeros(4), np.zeros(2))
        theirs = FIVE_BAR.acceleration(q, q_dot, np.zeros(2))
        assert np.abs(ours[[0, 2]] - theirs).max() < 1e-10 * np.abs(theirs).max()


RUNS: list[tuple[str, dict[str, Any]]] = [
    ("five_bar/swing", {"formulation": "dae"}),
    ("five_bar/swing", {"formulation": "dae", "solver.method": "Radau", "t_end": 0.5}),
    (
        "five_bar/swing",
        {"formulation": "dae", "solver.projection": False, "solver.baumgarte": [20.0, 20.0], "t_end": 0.5},
    ),
    ("five_bar/swing", {"formulation": "reduced"}),
    ("five_bar/swing", {"formulation": "spf", "epsilon": 1e-2, "initial.w": [0.01, -0.02]}),
    ("five_bar/swing", {"formulation": "spf", "spf_coordinates": "z", "epsilon": 1e-2, "t_end": 0.5}),
    ("five_bar/swing", {"formulation": "dae", "event": [{"of": "q_dot", "coordinate": "theta_1", "value": 1.0}]}),
    ("five_bar/tracking", {"t_end": 2.0}),
    ("five_bar/tracking", {"formulation": "dae", "t_end": 1.0, "controller.sample_time": 1e-3}),
    ("five_bar/set_point", {"t_end": 1.0}),
    ("flyball", {"formulation": "dae", "t_end": 1.0}),  # short: a last digit may turn 12 steps into 13
    ("bricard", {"formulation": "dae", "t_end": 1.0}),
]


@pytest.mark.parametrize(("scene", "overrides"), RUNS)
def test_runs_with_compiled_terms_are_those_with_pinocchios(scene: str, overrides: dict[str, Any]) -> None:
    """They take nearly the same steps and agree to ten times the tolerance of a step."""
    ours, theirs = (simulate(scene, {**overrides, "solver.terms": terms}) for terms in ("generated", "pinocchio"))
    assert (ours.stats["terms"], theirs.stats["terms"]) == ("generated", "pinocchio")
    assert (ours.status, len(ours.t), len(ours.events)) == (theirs.status, len(theirs.t), len(theirs.events))
    assert abs(ours.stats["steps"] - theirs.stats["steps"]) <= 0.1 * theirs.stats["steps"]
    assert ours.stats["rhs"] <= 1.1 * theirs.stats["rhs"]  # exact Jacobians cost no right-hand sides
    allowed = 10 * ours.scene["solver"]["rtol"]
    for a, b in ((ours.q_tree, theirs.q_tree), (ours.v_tree, theirs.v_tree), (ours.energy, theirs.energy)):
        assert np.abs(a - b).max() <= allowed * max(1.0, np.abs(b).max())


def test_a_run_passes_a_loss_of_rank_with_compiled_terms() -> None:
    """Near it elimination without pivoting would lose digits, so that the general core takes over."""
    overrides = {"formulation": "dae", "solver.rtol": 1e-8}
    ours, theirs = (simulate("n_four_bar", {**overrides, "solver.terms": x}) for x in ("generated", "pinocchio"))
    assert ours.status == theirs.status == "done"
    assert np.abs(ours.q_tree[-1] - theirs.q_tree[-1]).max() < 1e-6


def test_simulator_steps_with_compiled_terms() -> None:
    ours, theirs = (Simulator("five_bar/swing", {"solver.terms": terms}) for terms in ("generated", "pinocchio"))
    for k in range(50):
        u = np.array([0.1 * np.sin(k), 0.0])
        assert np.abs(ours.step(u, 2e-3).v_tree - theirs.step(u, 2e-3).v_tree).max() < 1e-7
    assert ours.stats["terms"] == "generated"


def test_a_long_run_compiles_its_terms_on_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Terms are compiled when the run has cost as much as compiling; the motion is the same."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(SIMULATE, "COMPILE_AFTER_RHS", 300)
    scene, overrides = "five_bar/set_point", {"formulation": "reduced", "solver.rtol": 1e-9}
    reference = simulate(scene, {**overrides, "solver.terms": "pinocchio"})
    assert reference.stats["rhs_by_terms"] == {"pinocchio": reference.stats["rhs"]}
    long = simulate(scene, overrides)
    by_terms = long.stats["rhs_by_terms"]
    assert long.stats["terms"] == "generated"
    assert 300 <= by_terms["pinocchio"] < 330  # the step in progress is finished first
    assert sum(by_terms.values()) == long.stats["rhs"] <= 1.1 * reference.stats["rhs"]
    assert f"compiled after {by_terms['pinocchio']}" in repr(long)
    assert_close(long.q_tree, reference.q_tree, 1e-8)
    again = simulate(scene, overrides)
    assert again.stats["rhs_by_terms"] == {"generated": pytest.approx(long.stats["rhs"], rel=0.1)}


def test_a_run_that_is_nearly_done_does_not_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does a run without a compiler."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    overrides = {"formulation": "reduced", "solver.rtol": 1e-9}
    reference = simulate("five_bar/set_point", overrides)
    monkeypatch.setattr(SIMULATE, "COMPILE_AFTER_RHS", reference.stats["rhs"] - 30)
    late = simulate("five_bar/set_point", overrides)
    assert late.stats["rhs_by_terms"] == reference.stats["rhs_by_terms"]
    assert np.array_equal(late.q_tree, reference.q_tree)
    monkeypatch.setattr(SIMULATE, "COMPILE_AFTER_RHS", 300)
    monkeypatch.setattr("ckc_pin.codegen.library.find_compiler", lambda fuses: None)
    late = simulate("five_bar/set_point", overrides)
    assert np.array_equal(late.q_tree, reference.q_tree)


LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/>'
    '<inertia ixx="{1}" iyy="{1}" izz="{1}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4} 0 0"/>{5}</joint>'
SLIDE = '<axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="9" velocity="9"/>'
HINGE = '<axis xyz="0 0 1"/>'
CRANK, ROD, SPEED = 0.3, 1.0, 4.0  # m, m, rad/s
SLIDER_CRANK = f"""
name = "slider_crank"
urdf = "slider_crank.urdf"
gravity = [0.0, 0.0, 0.0]
independent = ["crank"]
[q_guess]
crank = 0.4
pin = -0.5
slide = 1.27
[[loop]]
name = "piston"
type = "point_2d"
frame_a = {{ link = "rod", xyz = [{ROD}, 0.0, 0.0] }}
frame_b = {{ link = "piston" }}
axis_a = [0.0, 0.0, 1.0]
"""


def slider_crank(folder: Path, rod: float) -> Path:
    """Write a crank of 2 kg m^2, a piston of 3 kg, and a rod of a mass in kg, which may be zero."""
    links = '<link name="ground"/>' + LINK.format("crank", 2.0) + LINK.format("rod", rod) + LINK.format("piston", 3.0)
    joints = JOINT.format("crank", "continuous", "ground", "crank", 0.0, HINGE)
    joints += JOINT.format("pin", "continuous", "crank", "rod", CRANK, HINGE)
    joints += JOINT.format("slide", "prismatic", "ground", "piston", 0.0, SLIDE)
    (folder / "slider_crank.urdf").write_text(f'<robot name="slider_crank">{links}{joints}</robot>')
    (folder / "mechanism.toml").write_text(SLIDER_CRANK)
    (folder / "default.scene.toml").write_text(
        f'mechanism = "mechanism.toml"\nt_end = 3.0\n[initial]\nq = {{ crank = 0.4 }}\n'
        f"q_dot = {{ crank = {SPEED} }}\n[solver]\nrtol = 1e-10\n"
    )
    return folder


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_a_rod_without_mass_moves_with_its_loop(tmp_path: Path, formulation: str) -> None:
    """D' is singular, eq. 1 is not: the crank's speed follows from the conservation of energy."""
    run = simulate(slider_crank(tmp_path, 0.0), {"formulation": formulation, "solver.terms": "generated"})
    assert run.status == "done"
    assert set(run.stats["rhs_by_terms"]) == {"generated"}

    def inertia(angle: Any) -> Any:
        piston = CRANK * np.sin(angle) * (1 + CRANK * np.cos(angle) / np.sqrt(ROD**2 - (CRANK * np.sin(angle)) ** 2))
        return 2.0 + 3.0 * piston**2

    crank = run.mechanism.coordinates.index("crank")
    angle, speed = run.q_tree[:, crank], run.v_tree[:, crank]
    assert angle[-1] > 6.0
    assert_close(speed, SPEED * np.sqrt(inertia(0.4) / inertia(angle)), 1e-8)
    if formulation == "dae":
        assert_equal_terms(run.mechanism)


def test_a_mechanism_that_needs_pivoting_everywhere_is_refused_with_an_alternative(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("ckc_pin.codegen.comparison._is_well_conditioned", lambda terms, order: False)
    with pytest.raises(InputError, match=r'four_bar: .* with pivoting everywhere, .*; take solver.terms = "pinocchio"'):
        compile_terms(load("four_bar"))
