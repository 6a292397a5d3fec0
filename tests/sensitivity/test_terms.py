"""Sensitivities by code that is written out against those by Pinocchio's derivatives, and how often each is used."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import load, simulate
from ckc_pin.codegen.library import compile_terms
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.changed import TIGHT, written
from tests.sensitivity.spatial import arms, tethered

SAME = 1e-9  # of the largest: both are integrated


@pytest.fixture(autouse=True)
def cache(writable_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(writable_cache))


def both(scene: str, names: list[str], overrides: dict[str, Any]) -> tuple[Sensitivities, Sensitivities]:
    found = [sensitivities(scene, names, {**overrides, "solver.terms": terms}) for terms in ("generated", "pinocchio")]
    assert [x.run.stats["terms"] for x in found] == ["generated", "pinocchio"]
    return found[0], found[1]


def same(found: Sensitivities, other: Sensitivities) -> None:
    for part in ("q_tree", "v_tree", "u", "tau"):
        ours, theirs = getattr(found, part), getattr(other, part)
        for k, name in enumerate(found.parameters):
            largest = np.abs(theirs[:, :, k]).max(initial=0.0)
            assert np.abs(ours[:, :, k] - theirs[:, :, k]).max(initial=0.0) <= SAME * max(1e-3, largest), (part, name)


NAMES = [
    "link.crank.mass", "link.coupler.com.x", "link.rocker.inertia.izz", "joint.b.xyz", "joint.b.damping",
    "joint.c.armature", "loop.knee.frame_a.xyz.x", "loop.knee.frame_b.xyz.y", "spring.0.stiffness",
    "spring.0.rest_length", "spring.0.damping", "spring.0.frame_b.xyz",
    "spring.1.stiffness", "spring.1.rest", "force.0.value", "gravity", "initial.q.a",
    "initial.q_dot.a",
]  # fmt: skip


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_of_every_kind_of_number(formulation: str, tmp_path: Path) -> None:
    """Also of what is zero, as a rotor and gravity along x, which a library of its own takes."""
    scene = written(tmp_path, formulation=formulation)
    found, other = both(scene, NAMES, TIGHT)
    same(found, other)
    counts = found.run.stats["changes_by_terms"]
    assert counts["pinocchio"] == 0
    assert 0 < counts["generated"] <= found.run.stats["rhs"]
    plain = simulate(scene, {**TIGHT, "solver.terms": "generated"})
    assert found.run.stats["rhs"] <= 2 * plain.stats["rhs"]
    there = sensitivities(scene, NAMES, {**TIGHT, "solver.terms": "auto", "t_end": 0.1})
    assert there.run.stats["changes_by_terms"]["pinocchio"] == 0
    counts = other.run.stats["changes_by_terms"]
    assert counts["generated"] == 0
    assert 0 < counts["pinocchio"] <= other.run.stats["rhs"]


@pytest.mark.parametrize("terms", ["generated", "pinocchio"])
def test_a_right_hand_side_asks_once_how_it_changes(terms: str) -> None:
    """Whatever the number of parameters; to hold S to the tolerances takes a third more of them at the most."""
    names = ["link.link_2.mass", "initial.q.theta_1", "link.link_3.mass", "gravity.y", "link.link_2.com.x"]
    overrides = {"solver.rtol": 1e-9, "solver.terms": terms}
    plain = simulate("five_bar/swing", overrides).stats["rhs"]
    for count in (1, 2, 4, 5):  # along one direction, some of four, four, and four and one
        run = sensitivities("five_bar/swing", names[:count], overrides).run
        asked = run.stats["changes_by_terms"]
        assert sum(asked.values()) == asked[terms] == run.stats["rhs"]
        assert run.stats["rhs"] <= 1.34 * plain


def test_of_one_parameter_and_of_several_is_the_same() -> None:
    """One direction's code against that of four."""
    names = ["link.link_2.mass", "initial.q.theta_1", "link.link_3.mass", "gravity.y", "link.link_2.com.x"]
    overrides = {"solver.rtol": 1e-11, "solver.terms": "generated"}
    together = sensitivities("five_bar/swing", names, overrides)  # four, and one
    for name in (names[0], names[-1]):
        alone = sensitivities("five_bar/swing", [name], overrides)
        for coordinate in together.run.coordinates:
            curve = together.of(coordinate, name)
            assert np.abs(alone.of(coordinate, name) - curve).max() <= SAME * max(1e-3, np.abs(curve).max())


@pytest.mark.parametrize("there", [False, True])
def test_terms_that_are_compiled_on_the_way(there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say from there on how the motion changes, also where those of the motion alone were compiled before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys.modules["ckc_pin.run.simulate"], "REPAYS", 300)
    scene, names = written(tmp_path), ["link.crank.mass", "joint.b.armature", "initial.q.a"]
    if there:
        compile_terms(load(tmp_path / "bars.toml"))
    found = sensitivities(scene, names, {**TIGHT, "solver.terms": "auto"})
    same(found, sensitivities(scene, names, {**TIGHT, "solver.terms": "pinocchio"}))
    counts = found.run.stats["changes_by_terms"]
    assert 300 <= counts["pinocchio"] < 330  # up to the end of a step
    assert counts["generated"] > counts["pinocchio"]


def test_in_space_and_of_gears(tmp_path: Path) -> None:
    names = ["joint.rb.xyz", "joint.rb.armature", "coupling.0.ratio", "coupling.0.offset", "link.lhand.mass",
             "loop.hold.frame_a.xyz.z", "link.ltip.com.y"]  # fmt: skip
    found, other = both(arms(tmp_path, "prismatic"), names, TIGHT)
    same(found, other)
    assert found.run.stats["changes_by_terms"]["pinocchio"] == 0


def test_of_angles_the_tree_says_it(tmp_path: Path) -> None:
    """They are no arguments of the code, which gives the motion all the same."""
    found, other = both(arms(tmp_path, "hinge"), ["joint.lc.rpy.y", "link.lhand.mass"], TIGHT)
    same(found, other)
    assert found.run.stats["changes_by_terms"]["generated"] == 0


def test_under_control_and_through_impacts(tmp_path: Path) -> None:
    names = ["link.crank.mass", "controller.K_P", "controller.K_V", "gravity.y", "initial.q.a"]
    scene = written(tmp_path / "controlled", controlled=True, formulation="reduced")
    found, other = both(scene, names, TIGHT)
    same(found, other)
    assert found.run.stats["changes_by_terms"]["pinocchio"] == 0
    names = ["link.crank.mass", "joint.c.upper", "joint.c.restitution", "joint.c.xyz.x"]
    for restitution in (0.5, 0.0):  # it bounces; it stays there for a while
        overrides = {"joint.c.upper": 1.9, "joint.c.restitution": restitution}
        found, other = both(written(tmp_path / f"stop{restitution}", overrides, stop=True), names, TIGHT)
        same(found, other)
        assert found.run.stats["changes_by_terms"]["pinocchio"] == 0


def test_of_a_free_root(tmp_path: Path) -> None:
    """Whose place is a quaternion, whose changes are twists."""
    names = ["link.body.mass", "link.body.com.y", "gravity.x", "spring.0.stiffness", "spring.0.frame_a.xyz"]
    names += ["joint.root.xyz", "initial.q_dot.root.rx"]
    found, other = both(tethered(tmp_path), names, TIGHT)
    same(found, other)
    assert found.run.stats["changes_by_terms"]["pinocchio"] == 0
