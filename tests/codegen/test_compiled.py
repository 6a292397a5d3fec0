"""Terms written out for a mechanism against Pinocchio's, in the native core and along runs."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, Simulator, load, simulate
from ckc_pin.codegen.library import compiled
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

RUNNING = import_module("ckc_pin.run.simulate")  # whose name is also a function's
SHIPPED = ["five_bar", "slider_crank_spatial", "bricard", "flyball", "andrews"]
FREE, COUPLED = 18, 14  # of random ones: a free root on a damped spring; redundant rows, a coupling


def are_alike(mechanism: Mechanism, count: int = 20) -> None:
    """All terms of two cores, and the accelerations that follow, at random states on the closure and off it."""
    ours, theirs = _core.Core(core_table(mechanism, compiled(mechanism))), _core.Core(core_table(mechanism))
    random, n = np.random.default_rng(7), mechanism.n
    for k in range(count):
        closed = k % 2 == 0
        q = mechanism.q_tree if closed else mechanism.tree.integrate(mechanism.q_tree, 0.3 * random.uniform(-1, 1, n))
        v, u = random.uniform(-2, 2, n), random.uniform(-1, 1, n)
        if closed:
            J = theirs.jacobian(q)
            v = v - np.linalg.pinv(J, rcond=1e-9) @ (J @ v)
        wanted, found = theirs.terms(q, v), ours.terms(q, v)
        for name, right in wanted.items():
            scale = max(1.0, float(np.abs(right).max(initial=0.0)))
            assert np.abs(np.asarray(found[name]) - right).max(initial=0.0) <= 1e-11 * scale, name
        if closed or not mechanism.redundant:
            correction = np.zeros(mechanism.closure.rows)
            right = theirs.dae_acceleration(q, v, u, correction)
            off = np.abs(ours.dae_acceleration(q, v, u, correction) - right).max()
            assert off <= 1e-11 * np.abs(right).max()


@pytest.mark.parametrize("name", SHIPPED)
def test_terms_of_shipped_mechanisms_are_pinocchios(name: str) -> None:
    are_alike(load(name))


@pytest.mark.parametrize("seed", [FREE, COUPLED])
def test_terms_of_random_mechanisms_are_pinocchios(seed: int, tmp_path: Path) -> None:
    are_alike(load(random_mechanism(seed).write(tmp_path / "mechanism")))


def test_the_acceleration_is_that_of_the_appendix() -> None:
    """Of the five-bar in numpy, none of whose code is ours."""
    mechanism = load("five_bar")
    core, random = _core.Core(core_table(mechanism, compiled(mechanism))), np.random.default_rng(3)
    for _ in range(20):
        q = FIVE_BAR.sigma(np.array([-1.4, -1.7]) + random.uniform(-0.3, 0.3, 2))
        q_dot = random.uniform(-3, 3, 2)
        v = FIVE_BAR.rho(q) @ q_dot
        found = core.dae_acceleration(q, v, np.zeros(4), np.zeros(2))
        right = FIVE_BAR.acceleration(q, q_dot, np.zeros(2))
        assert np.abs(found[[0, 2]] - right).max() < 1e-10 * np.abs(right).max()


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
    ("flyball", {"formulation": "dae", "t_end": 1.0}),  # of 12 steps a last bit makes 13
    ("bricard", {"formulation": "dae", "t_end": 1.0}),
]


@pytest.mark.parametrize(("scene", "overrides"), RUNS)
def test_runs_end_where_they_did(scene: str, overrides: dict[str, Any]) -> None:
    """After nearly the same steps, to ten times what a step may be off."""
    ours, theirs = (simulate(scene, {**overrides, "solver.terms": terms}) for terms in ("generated", "pinocchio"))
    assert (ours.stats["terms"], theirs.stats["terms"]) == ("generated", "pinocchio")
    assert (ours.status, len(ours.t), len(ours.events)) == (theirs.status, len(theirs.t), len(theirs.events))
    assert abs(ours.stats["steps"] - theirs.stats["steps"]) <= 0.1 * theirs.stats["steps"]
    assert ours.stats["rhs"] <= 1.1 * theirs.stats["rhs"]  # an exact Jacobian takes none
    allowed = 10 * ours.scene["solver"]["rtol"]
    for a, b in ((ours.q_tree, theirs.q_tree), (ours.v_tree, theirs.v_tree), (ours.energy, theirs.energy)):
        assert np.abs(a - b).max() <= allowed * max(1.0, np.abs(b).max())


def test_a_loss_of_rank_is_passed_as_before() -> None:
    """Next to it elimination without pivoting would lose its digits: the core takes over."""
    overrides = {"formulation": "dae", "solver.rtol": 1e-8}
    ours, theirs = (simulate("n_four_bar", {**overrides, "solver.terms": x}) for x in ("generated", "pinocchio"))
    assert ours.status == theirs.status == "done"
    assert np.abs(ours.q_tree[-1] - theirs.q_tree[-1]).max() < 1e-6


def test_a_simulator_steps_with_them() -> None:
    ours, theirs = (Simulator("five_bar/swing", {"solver.terms": terms}) for terms in ("generated", "pinocchio"))
    for k in range(50):
        u = np.array([0.1 * np.sin(k), 0.0])
        assert np.abs(ours.step(u, 2e-3).v_tree - theirs.step(u, 2e-3).v_tree).max() < 1e-7
    assert ours.stats["terms"] == "generated"


def test_a_long_run_compiles_on_its_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once it has cost what compiling does, and from where it is; the motion is the same."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(RUNNING, "REPAYS", 300)
    scene, overrides = "five_bar/set_point", {"formulation": "reduced", "solver.rtol": 1e-9}
    usual = simulate(scene, {**overrides, "solver.terms": "pinocchio"})
    assert usual.stats["rhs_by_terms"] == {"pinocchio": usual.stats["rhs"]}
    long = simulate(scene, overrides)
    by_terms = long.stats["rhs_by_terms"]
    assert long.stats["terms"] == "generated"
    assert 300 <= by_terms["pinocchio"] < 330  # up to the end of a step
    assert sum(by_terms.values()) == long.stats["rhs"] <= 1.1 * usual.stats["rhs"]
    assert f"compiled after {by_terms['pinocchio']}" in repr(long)
    assert_close(long.q_tree, usual.q_tree, 1e-8)
    assert simulate(scene, overrides).stats["rhs_by_terms"] == {"generated": pytest.approx(long.stats["rhs"], rel=0.1)}


def test_a_run_that_is_nearly_done_does_not_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    overrides = {"formulation": "reduced", "solver.rtol": 1e-9}
    usual = simulate("five_bar/set_point", overrides)
    monkeypatch.setattr(RUNNING, "REPAYS", usual.stats["rhs"] - 30)
    late = simulate("five_bar/set_point", overrides)
    assert late.stats["rhs_by_terms"] == usual.stats["rhs_by_terms"]
    assert np.array_equal(late.q_tree, usual.q_tree)
    monkeypatch.setattr(RUNNING, "REPAYS", 300)
    monkeypatch.setattr("ckc_pin.codegen.library._compiler", lambda fuses: None)  # and neither does one that cannot
    late = simulate("five_bar/set_point", overrides)
    assert np.array_equal(late.q_tree, usual.q_tree)


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
    """A crank of 2 kg m^2, a piston of 3 kg, and a rod without mass, or with some."""
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
    """D' is singular, eq. 1 is not: the crank's speed is what the energy says."""
    overrides = {"formulation": formulation, "solver.terms": "generated"}
    run = simulate(slider_crank(tmp_path, 0.0), overrides)
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
        are_alike(run.mechanism)


def test_what_is_never_eliminated_soundly_names_a_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("ckc_pin.codegen.comparison._sound", lambda terms, order: False)
    with pytest.raises(InputError, match=r'four_bar: .* with pivoting everywhere, .*; take solver.terms = "pinocchio"'):
        compiled(load("four_bar"))
