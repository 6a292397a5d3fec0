"""Sensitivities by compiled terms against those by Pinocchio, and how often each of them is used."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import load, simulate
from ckc_pin.codegen.library import compile_terms
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.sensitivity.four_bar import TIGHT, write_four_bar
from tests.sensitivity.spatial import write_arms, write_tethered_body

TOLERANCE = 1e-9  # relative to the largest


@pytest.fixture(autouse=True)
def cache(writable_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(writable_cache))


def compute_with_both(scene: str, names: list[str], overrides: dict[str, Any]) -> tuple[Sensitivities, Sensitivities]:
    results = [
        sensitivities(scene, names, {**overrides, "solver.terms": terms}) for terms in ("generated", "pinocchio")
    ]
    assert [x.run.stats["terms"] for x in results] == ["generated", "pinocchio"]
    return results[0], results[1]


def require_equal(result: Sensitivities, other: Sensitivities) -> None:
    for part in ("q_tree", "v_tree", "u", "tau"):
        ours, theirs = getattr(result, part), getattr(other, part)
        for k, name in enumerate(result.parameters):
            largest = np.abs(theirs[:, :, k]).max(initial=0.0)
            assert np.abs(ours[:, :, k] - theirs[:, :, k]).max(initial=0.0) <= TOLERANCE * max(1e-3, largest), (
                part,
                name,
            )


NAMES = [
    "link.crank.mass", "link.coupler.com.x", "link.rocker.inertia.izz", "joint.b.xyz", "joint.b.damping",
    "joint.c.armature", "loop.knee.frame_a.xyz.x", "loop.knee.frame_b.xyz.y", "spring.0.stiffness",
    "spring.0.rest_length", "spring.0.damping", "spring.0.frame_b.xyz",
    "spring.1.stiffness", "spring.1.rest", "force.0.value", "gravity", "initial.q.a",
    "initial.q_dot.a",
]  # fmt: skip


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_all_kinds_of_parameters(formulation: str, tmp_path: Path) -> None:
    """Including parameters that are zero, such as a rotor and gravity along x, which need a library of their own."""
    scene = write_four_bar(tmp_path, formulation=formulation)
    result, other = compute_with_both(scene, NAMES, TIGHT)
    require_equal(result, other)
    counts = result.run.stats["changes_by_terms"]
    assert counts["pinocchio"] == 0
    assert 0 < counts["generated"] <= result.run.stats["rhs"]
    plain = simulate(scene, {**TIGHT, "solver.terms": "generated"})
    assert result.run.stats["rhs"] <= 2 * plain.stats["rhs"]
    cached = sensitivities(scene, NAMES, {**TIGHT, "solver.terms": "auto", "t_end": 0.1})
    assert cached.run.stats["changes_by_terms"]["pinocchio"] == 0
    counts = other.run.stats["changes_by_terms"]
    assert counts["generated"] == 0
    assert 0 < counts["pinocchio"] <= other.run.stats["rhs"]


@pytest.mark.parametrize("terms", ["generated", "pinocchio"])
def test_each_right_hand_side_is_differentiated_once(terms: str) -> None:
    """For any number of parameters. Error control of S takes at most a third more right-hand sides."""
    names = ["link.link_2.mass", "initial.q.theta_1", "link.link_3.mass", "gravity.y", "link.link_2.com.x"]
    overrides = {"solver.rtol": 1e-9, "solver.terms": terms}
    plain = simulate("five_bar/swing", overrides).stats["rhs"]
    for count in (1, 2, 4, 5):  # one direction, part of a group of four, four, and four plus one
        run = sensitivities("five_bar/swing", names[:count], overrides).run
        counts = run.stats["changes_by_terms"]
        assert sum(counts.values()) == counts[terms] == run.stats["rhs"]
        assert run.stats["rhs"] <= 1.34 * plain


def test_results_do_not_depend_on_the_number_of_parameters() -> None:
    """Code for one direction against code for four directions."""
    names = ["link.link_2.mass", "initial.q.theta_1", "link.link_3.mass", "gravity.y", "link.link_2.com.x"]
    overrides = {"solver.rtol": 1e-11, "solver.terms": "generated"}
    together = sensitivities("five_bar/swing", names, overrides)  # four plus one
    for name in (names[0], names[-1]):
        alone = sensitivities("five_bar/swing", [name], overrides)
        for coordinate in together.run.coordinates:
            curve = together.of(coordinate, name)
            assert np.abs(alone.of(coordinate, name) - curve).max() <= TOLERANCE * max(1e-3, np.abs(curve).max())


@pytest.mark.parametrize("has_library", [False, True])
def test_terms_compiled_during_a_run_take_over(
    has_library: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the terms of the motion alone were compiled before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys.modules["ckc_pin.run.simulate"], "COMPILE_AFTER_RHS", 300)
    scene, names = write_four_bar(tmp_path), ["link.crank.mass", "joint.b.armature", "initial.q.a"]
    if has_library:
        compile_terms(load(tmp_path / "bars.toml"))
    result = sensitivities(scene, names, {**TIGHT, "solver.terms": "auto"})
    require_equal(result, sensitivities(scene, names, {**TIGHT, "solver.terms": "pinocchio"}))
    counts = result.run.stats["changes_by_terms"]
    assert 300 <= counts["pinocchio"] < 330  # up to the end of a step
    assert counts["generated"] > counts["pinocchio"]


def test_spatial_mechanisms_and_gears(tmp_path: Path) -> None:
    names = ["joint.rb.xyz", "joint.rb.armature", "coupling.0.ratio", "coupling.0.offset", "link.lhand.mass",
             "loop.hold.frame_a.xyz.z", "link.ltip.com.y"]  # fmt: skip
    result, other = compute_with_both(write_arms(tmp_path, "prismatic"), names, TIGHT)
    require_equal(result, other)
    assert result.run.stats["changes_by_terms"]["pinocchio"] == 0


def test_angles_use_pinocchios_derivatives(tmp_path: Path) -> None:
    """Angles are not arguments of the compiled code, which still computes the motion."""
    result, other = compute_with_both(write_arms(tmp_path, "hinge"), ["joint.lc.rpy.y", "link.lhand.mass"], TIGHT)
    require_equal(result, other)
    assert result.run.stats["changes_by_terms"]["generated"] == 0


def test_controllers_and_impacts(tmp_path: Path) -> None:
    names = ["link.crank.mass", "controller.K_P", "controller.K_V", "gravity.y", "initial.q.a"]
    scene = write_four_bar(tmp_path / "controlled", controlled=True, formulation="reduced")
    result, other = compute_with_both(scene, names, TIGHT)
    require_equal(result, other)
    assert result.run.stats["changes_by_terms"]["pinocchio"] == 0
    names = ["link.crank.mass", "joint.c.upper", "joint.c.restitution", "joint.c.xyz.x"]
    for restitution in (0.5, 0.0):  # it bounces, or rests at the stop for a while
        overrides = {"joint.c.upper": 1.9, "joint.c.restitution": restitution}
        result, other = compute_with_both(
            write_four_bar(tmp_path / f"stop{restitution}", overrides, stop=True), names, TIGHT
        )
        require_equal(result, other)
        assert result.run.stats["changes_by_terms"]["pinocchio"] == 0


def test_a_free_root(tmp_path: Path) -> None:
    """Its configuration is a quaternion, and its derivatives are twists."""
    names = ["link.body.mass", "link.body.com.y", "gravity.x", "spring.0.stiffness", "spring.0.frame_a.xyz"]
    names += ["joint.root.xyz", "initial.q_dot.root.rx"]
    result, other = compute_with_both(write_tethered_body(tmp_path), names, TIGHT)
    require_equal(result, other)
    assert result.run.stats["changes_by_terms"]["pinocchio"] == 0
