"""What a check says of a closed loop beside what runs do: other branches, other models, stops, limits, few motors."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import Stability, check, load, load_scene, simulate
from ckc_pin.control.controllers import Tracking
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import assembly_branches, sigma
from ckc_pin.mechanism.library import library
from ckc_pin.scene.parts import scene_controller
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.analytic.test_stability import waves
from tests.analytic.test_workspace import EDGE

NAMES = ("theta_1", "theta_3")
HANGING = np.array([-1.434, -1.707])


def verdict(name: str, overrides: dict[str, Any]) -> Stability:
    found = check(load_scene(name, overrides)).stability
    assert found is not None
    return found


def target(q_d: Array) -> dict[str, Any]:
    return {"controller.q_d": dict(zip(NAMES, q_d.tolist(), strict=True))}


def copied(folder: Path, *edits: tuple[str, str]) -> Path:
    """Another five-bar."""
    path = folder / "other"
    shutil.copytree(library() / "five_bar", path)
    text = (path / "mechanism.toml").read_text("utf-8")
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    (path / "mechanism.toml").write_text(text, "utf-8")
    return path


# --- where it rests ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_on_another_branch_it_is_the_target_there(seed: int) -> None:
    """The tip above the elbows: the run comes to rest at its target, within 16 time constants of the slowest decay."""
    random = np.random.default_rng(seed)
    mechanism = load("five_bar")
    other = mechanism.tree.named(mechanism.tree.to_coordinates(assembly_branches(mechanism)[1].q_tree))
    q_d = HANGING + random.uniform(-0.2, 0.2, 2)
    overrides = {**target(q_d), "initial": {"q": other}, "controller.K_P": float(random.uniform(0.5, 2.0))}
    found = verdict("five_bar/set_point", overrides)
    assert found.stable
    assert found.offset == pytest.approx([0.0, 0.0], abs=1e-12)
    assert found.slowest is not None
    exact = {"formulation": "reduced", "t_end": 16 * found.slowest, "solver.rtol": 1e-10}
    run = simulate("five_bar/set_point", {**overrides, **exact})
    errors = np.abs(run.q_tree[:, [0, 2]] - q_d).max(axis=1)
    assert run.q_tree[-1][1] == pytest.approx(2.6, abs=0.3)
    assert errors[-1] < 1e-5 * errors[0]


def test_on_another_branch_tracking_is_judged_there() -> None:
    """At its start: -Lambda, and r_dot = -D^-1 (C + K_D) r with the terms of that branch."""
    mechanism = load("five_bar")
    other = mechanism.tree.named(mechanism.tree.to_coordinates(assembly_branches(mechanism)[1].q_tree))
    scene = load_scene("five_bar/tracking", waves(2.0) | {"initial": {"q": other}, "controller.K_D": 0.1})
    law = scene_controller(scene, mechanism)
    assert isinstance(law, Tracking)
    q_d, q_d_dot, _ = law.desired(0.0)
    there = mechanism.kinematics(mechanism.tree.from_coordinates(np.array([other[x] for x in mechanism.coordinates])))
    at = sigma(mechanism, q_d, there).at
    state = Terms(mechanism, at, at.rho @ q_d_dot)
    wanted = np.concatenate([[-1.0, -1.0], np.linalg.eigvals(-np.linalg.solve(state.D, state.C + law.K_D))])
    found = check(scene).stability
    assert found is not None
    assert found.stable
    assert found.eigenvalues is not None
    assert np.sort_complex(found.eigenvalues) == pytest.approx(np.sort_complex(wanted), rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_with_another_model_it_rests_where_a_run_ends(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    pull = f"gravity = [{random.uniform(-9, 9):.3f}, {random.uniform(-18, 9):.3f}, 0.0]"
    model = copied(tmp_path, ("gravity = [0.0, -9.81, 0.0]", pull))
    gains = {"controller.K_P": float(random.uniform(1.5, 5.0)), "controller.model": str(model / "mechanism.toml")}
    overrides = {**target(HANGING + random.uniform(-0.3, 0.3, 2)), **gains}
    scene = load_scene("five_bar/set_point", overrides)
    said = check(scene)
    found = said.stability
    assert found is not None
    assert found.stable
    assert found.least_K_P is None
    assert any("rests off its target" in warning for warning in said.warnings)
    run = simulate("five_bar/set_point", {**overrides, "t_end": 30.0, "formulation": "reduced"})
    off = run.q_tree[-1][[0, 2]] - list(overrides["controller.q_d"].values())
    assert np.abs(off).max() > 0.05
    assert found.offset == pytest.approx(off, abs=1e-6)


def test_a_model_too_far_from_the_mechanism_leaves_no_rest_near_the_target(tmp_path: Path) -> None:
    """Newton's method from the target would end at some other equilibrium; following it says that there is none."""
    model = copied(tmp_path, ("gravity = [0.0, -9.81, 0.0]", "gravity = [0.0, 200.0, 0.0]"))
    overrides = target(np.array([-0.9, -2.2])) | {"controller.K_P": 0.3}
    found = verdict("five_bar/set_point", {**overrides, "controller.model": str(model / "mechanism.toml")})
    assert found.stable is None
    assert "has no rest near its target" in str(found.reason)


def test_at_a_singular_target_nothing_is_said() -> None:
    swing = EDGE * (1 - 1e-12)
    found = verdict("five_bar/set_point", target(np.array([-swing, swing]) - np.pi / 2))
    assert found.stable is None
    assert found.reason == "the target is singular: theta_1, theta_3 do not determine theta_2, theta_4 there"


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_without_damping_the_warning_asks_for_it(sample_time: float | None) -> None:
    said = check(load_scene("five_bar/set_point", {"controller.K_V": 0.0, "controller.sample_time": sample_time}))
    assert said.stability is not None
    assert said.stability.stable is False
    assert any("does not come to rest at its target" in warning and "give K_V" in warning for warning in said.warnings)
    assert not any("least K_P" in warning for warning in said.warnings)


# --- where a run cannot be as the linear model says --------------------------------------------------


def test_a_limit_below_what_holds_the_target_is_named() -> None:
    q_d = np.array([-0.6, -2.4])
    needed = np.abs(FIVE_BAR.h(FIVE_BAR.sigma(q_d)))
    for factor, stable in ((1.001, True), (0.999, None)):
        found = verdict("five_bar/set_point", target(q_d) | {"controller.torque_limit": factor * float(needed.max())})
        assert found.stable is stable
        assert found.leaves_out == ("torque limits",)
    name = NAMES[int(np.argmax(needed))]
    assert f"{name} would need {needed.max():.4g}, its limit is" in str(found.reason)


def test_a_limit_below_what_the_motion_needs_is_named() -> None:
    """The largest torque along the desired motion, from a run that starts on it."""
    started = {"q": {"theta_1": 0.0, "theta_3": 0.0}, "q_dot": {"theta_1": np.pi / 3, "theta_3": 0.0}}
    on_it = {"initial": started, "formulation": "reduced", "solver.output_dt": 1e-3, "t_end": 6.5}
    needed = float(np.abs(simulate("five_bar/tracking", on_it).tau).max())
    for factor, stable in ((1.01, True), (0.99, None)):
        found = verdict("five_bar/tracking", {"controller.torque_limit": factor * needed, "t_end": 6.5})
        assert found.stable is stable
    assert "of the desired motion" in str(found.reason)
    assert f"its limit is {0.99 * needed:.4g}" in str(found.reason)


def test_a_target_beyond_a_stop_is_named(tmp_path: Path) -> None:
    folder = copied(tmp_path, ("[[point]]", '[[joint]]\nname = "theta_1"\nstops = true\n\n[[point]]'))
    urdf = (folder / "five_bar.urdf").read_text("utf-8")
    limited = '"theta_1" type="revolute"><limit lower="-2.0" upper="-1.0" effort="1" velocity="1"/>'
    (folder / "five_bar.urdf").write_text(urdf.replace('"theta_1" type="continuous">', limited), "utf-8")
    scene = {"mechanism": str(folder / "mechanism.toml"), "initial": {"at": "assembled"}}
    inside = verdict("five_bar/set_point", scene | target(np.array([-1.1, -1.7])))
    assert inside.stable
    assert inside.leaves_out == ("stops",)
    outside = verdict("five_bar/set_point", scene | target(np.array([-0.9, -1.7])))
    assert outside.stable is None
    assert "theta_1 = -0.9 is beyond its stops, -2 to -1" in str(outside.reason)


def test_where_the_run_is_refused_nothing_is_said_to_be_stable(tmp_path: Path) -> None:
    folder = copied(tmp_path, ('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]'))
    found = verdict("five_bar/set_point", {"mechanism": str(folder / "mechanism.toml")})
    assert found.stable is None
    assert "a run does not begin: actuated: theta_1 cannot hold every freedom" in str(found.reason)


def on_its_way(overrides: dict[str, Any], t_end: float) -> tuple[dict[str, Any], Tracking]:
    """Tracking of the five-bar that starts on its desired motion."""
    scene = load_scene("five_bar/tracking", overrides)
    law = scene_controller(scene, load("five_bar"))
    assert isinstance(law, Tracking)
    q, q_dot, _ = (dict(zip(NAMES, x.tolist(), strict=True)) for x in law.desired(0.0))
    exact = {"formulation": "reduced", "solver.rtol": 1e-10, "t_end": t_end}
    return {**overrides, **exact, "initial": {"q": q, "q_dot": q_dot}}, law


DRIVEN = [
    ({"controller.K_D": 0.5, "controller.sample_time": 0.01}, 0.08),
    ({"controller.K_D": 0.3, "controller.sample_time": 0.004, "controller.delay": 0.005}, 0.05),
    ({"controller.model": "five_bar_as_printed"}, 0.1),
    ({"friction_smoothing": 0.2, **{f"joint.{name}.friction": 0.05 for name in NAMES}}, 0.05),
]


@pytest.mark.parametrize(("overrides", "rel"), DRIVEN, ids=lambda x: str(x)[:40])
def test_what_takes_a_motion_off_the_desired_one_is_what_a_run_shows(overrides: dict[str, Any], rel: float) -> None:
    """Samples, delay, another model, friction; up to what is not linear in it."""
    on_it, law = on_its_way(waves(6.0) | overrides, 2.0)
    found, run = verdict("five_bar/tracking", on_it), simulate("five_bar/tracking", on_it)
    wanted = np.array([law.desired(float(t))[0] for t in run.t])
    off = np.abs(run.q_tree[:, [0, 2]] - wanted).max(axis=0)
    assert off.max() > 1e-3
    assert found.offset == pytest.approx(off, rel=rel)
    assert found.stable


def test_a_motion_far_off_the_desired_one_has_no_verdict() -> None:
    """Errors fall along the desired motion, but the run is elsewhere."""
    found = verdict("five_bar/tracking", waves(6.0) | {"friction_smoothing": 0.2, "joint.theta_1.friction": 5.0})
    assert found.growth is not None
    assert found.growth < 1
    assert found.stable is None
    assert "off it, by sampling, delay, friction or its model" in str(found.reason)


@pytest.mark.parametrize(
    ("name", "sampling"),
    [("five_bar/set_point", {"sample_time": 1e-3, "delay": 0.21}), ("five_bar/tracking", {"sample_time": 1e-4})],
)
def test_where_samples_are_too_many_nothing_is_said(name: str, sampling: dict[str, float]) -> None:
    found = verdict(name, {f"controller.{key}": x for key, x in sampling.items()})
    assert found.stable is None
    assert "samples" in str(found.reason)
