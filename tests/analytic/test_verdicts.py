"""Stability that check reports against runs: assembly branches, other models, stops, torque limits, disturbances."""

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
from ckc_pin.scene.parts import build_scene_controller
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.analytic.test_stability import waves
from tests.analytic.test_workspace import EDGE

NAMES = ("theta_1", "theta_3")
HANGING = np.array([-1.434, -1.707])


def check_stability(name: str, overrides: dict[str, Any]) -> Stability:
    result = check(load_scene(name, overrides)).stability
    assert result is not None
    return result


def target(q_d: Array) -> dict[str, Any]:
    return {"controller.q_d": dict(zip(NAMES, q_d.tolist(), strict=True))}


def copy_five_bar(folder: Path, *replacements: tuple[str, str]) -> Path:
    """Copy the five-bar with replacements in its mechanism.toml."""
    path = folder / "other"
    shutil.copytree(library() / "five_bar", path)
    text = (path / "mechanism.toml").read_text("utf-8")
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    (path / "mechanism.toml").write_text(text, "utf-8")
    return path


# --- position of rest ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_the_target_is_on_the_assembly_branch_of_the_start(seed: int) -> None:
    """With the tip above the elbows, the run is at its target after 16 time constants of the slowest decay."""
    random = np.random.default_rng(seed)
    mechanism = load("five_bar")
    other = mechanism.tree.named(mechanism.tree.to_coordinates(assembly_branches(mechanism)[1].q_tree))
    q_d = HANGING + random.uniform(-0.2, 0.2, 2)
    overrides = {**target(q_d), "initial": {"q": other}, "controller.K_P": float(random.uniform(0.5, 2.0))}
    result = check_stability("five_bar/set_point", overrides)
    assert result.stable
    assert result.offset == pytest.approx([0.0, 0.0], abs=1e-12)
    assert result.slowest is not None
    exact = {"formulation": "reduced", "t_end": 16 * result.slowest, "solver.rtol": 1e-10}
    run = simulate("five_bar/set_point", {**overrides, **exact})
    errors = np.abs(run.q_tree[:, [0, 2]] - q_d).max(axis=1)
    assert run.q_tree[-1][1] == pytest.approx(2.6, abs=0.3)
    assert errors[-1] < 1e-5 * errors[0]


def test_tracking_is_linearized_on_the_assembly_branch_of_the_start() -> None:
    """Eigenvalues at its start are those of -Lambda and of -D^-1 (C + K_D), with the terms of that branch."""
    mechanism = load("five_bar")
    other = mechanism.tree.named(mechanism.tree.to_coordinates(assembly_branches(mechanism)[1].q_tree))
    scene = load_scene("five_bar/tracking", waves(2.0) | {"initial": {"q": other}, "controller.K_D": 0.1})
    law = build_scene_controller(scene, mechanism)
    assert isinstance(law, Tracking)
    q_d, q_d_dot, _ = law.desired(0.0)
    there = mechanism.kinematics(mechanism.tree.from_coordinates(np.array([other[x] for x in mechanism.coordinates])))
    at = sigma(mechanism, q_d, there).at
    state = Terms(mechanism, at, at.rho @ q_d_dot)
    expected = np.concatenate([[-1.0, -1.0], np.linalg.eigvals(-np.linalg.solve(state.D, state.C + law.K_D))])
    result = check(scene).stability
    assert result is not None
    assert result.stable
    assert result.eigenvalues is not None
    assert np.sort_complex(result.eigenvalues) == pytest.approx(np.sort_complex(expected), rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_position_of_rest_with_another_model_is_the_end_of_a_run(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    pull = f"gravity = [{random.uniform(-9, 9):.3f}, {random.uniform(-18, 9):.3f}, 0.0]"
    model = copy_five_bar(tmp_path, ("gravity = [0.0, -9.81, 0.0]", pull))
    gains = {"controller.K_P": float(random.uniform(1.5, 5.0)), "controller.model": str(model / "mechanism.toml")}
    overrides = {**target(HANGING + random.uniform(-0.3, 0.3, 2)), **gains}
    scene = load_scene("five_bar/set_point", overrides)
    report = check(scene)
    result = report.stability
    assert result is not None
    assert result.stable
    assert result.least_K_P is None
    assert any("comes to rest off its target" in warning for warning in report.warnings)
    run = simulate("five_bar/set_point", {**overrides, "t_end": 30.0, "formulation": "reduced"})
    off = run.q_tree[-1][[0, 2]] - list(overrides["controller.q_d"].values())
    assert np.abs(off).max() > 0.05
    assert result.offset == pytest.approx(off, abs=1e-6)


def test_stability_with_a_very_different_model_is_unknown(tmp_path: Path) -> None:
    """Newton's method would find an unrelated equilibrium; continuation finds that there is none near the target."""
    model = copy_five_bar(tmp_path, ("gravity = [0.0, -9.81, 0.0]", "gravity = [0.0, 200.0, 0.0]"))
    overrides = target(np.array([-0.9, -2.2])) | {"controller.K_P": 0.3}
    result = check_stability("five_bar/set_point", {**overrides, "controller.model": str(model / "mechanism.toml")})
    assert result.stable is None
    assert "has no position of rest near its target" in str(result.reason)


def test_stability_at_a_singular_target_is_unknown() -> None:
    swing = EDGE * (1 - 1e-12)
    result = check_stability("five_bar/set_point", target(np.array([-swing, swing]) - np.pi / 2))
    assert result.stable is None
    assert result.reason == "the target is singular: theta_1, theta_3 do not determine theta_2, theta_4 there"


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_a_warning_suggests_damping_for_an_undamped_loop(sample_time: float | None) -> None:
    report = check(load_scene("five_bar/set_point", {"controller.K_V": 0.0, "controller.sample_time": sample_time}))
    assert report.stability is not None
    assert report.stability.stable is False
    assert any(
        "does not come to rest at its target" in warning and "give K_V" in warning for warning in report.warnings
    )
    assert not any("least K_P" in warning for warning in report.warnings)


# --- limits of the linear model ------------------------------------------------------------------


def test_the_reason_names_a_torque_limit_that_cannot_hold_the_target() -> None:
    q_d = np.array([-0.6, -2.4])
    needed = np.abs(FIVE_BAR.h(FIVE_BAR.sigma(q_d)))
    for factor, stable in ((1.001, True), (0.999, None)):
        result = check_stability(
            "five_bar/set_point", target(q_d) | {"controller.torque_limit": factor * float(needed.max())}
        )
        assert result.stable is stable
        assert result.leaves_out == ("torque limits",)
    name = NAMES[int(np.argmax(needed))]
    assert f"{name} would need {needed.max():.4g}, its limit is" in str(result.reason)


def test_the_reason_names_a_torque_limit_that_the_motion_exceeds() -> None:
    """The largest torque along the desired motion, from a run that starts on it."""
    started = {"q": {"theta_1": 0.0, "theta_3": 0.0}, "q_dot": {"theta_1": np.pi / 3, "theta_3": 0.0}}
    on_it = {"initial": started, "formulation": "reduced", "solver.output_dt": 1e-3, "t_end": 6.5}
    needed = float(np.abs(simulate("five_bar/tracking", on_it).tau).max())
    for factor, stable in ((1.01, True), (0.99, None)):
        result = check_stability("five_bar/tracking", {"controller.torque_limit": factor * needed, "t_end": 6.5})
        assert result.stable is stable
    assert "of the desired motion" in str(result.reason)
    assert f"its limit is {0.99 * needed:.4g}" in str(result.reason)


def test_the_reason_names_a_stop_that_the_target_violates(tmp_path: Path) -> None:
    folder = copy_five_bar(tmp_path, ("[[point]]", '[[joint]]\nname = "theta_1"\nstops = true\n\n[[point]]'))
    urdf = (folder / "five_bar.urdf").read_text("utf-8")
    limited = '"theta_1" type="revolute"><limit lower="-2.0" upper="-1.0" effort="1" velocity="1"/>'
    (folder / "five_bar.urdf").write_text(urdf.replace('"theta_1" type="continuous">', limited), "utf-8")
    scene = {"mechanism": str(folder / "mechanism.toml"), "initial": {"at": "assembled"}}
    inside = check_stability("five_bar/set_point", scene | target(np.array([-1.1, -1.7])))
    assert inside.stable
    assert inside.leaves_out == ("stops",)
    outside = check_stability("five_bar/set_point", scene | target(np.array([-0.9, -1.7])))
    assert outside.stable is None
    assert "theta_1 = -0.9 is beyond its stops, -2 to -1" in str(outside.reason)


def test_stability_of_a_scene_that_cannot_run_is_unknown(tmp_path: Path) -> None:
    folder = copy_five_bar(tmp_path, ('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]'))
    result = check_stability("five_bar/set_point", {"mechanism": str(folder / "mechanism.toml")})
    assert result.stable is None
    assert "a run cannot start: actuated: theta_1 cannot drive every freedom" in str(result.reason)


def start_on_motion(overrides: dict[str, Any], t_end: float) -> tuple[dict[str, Any], Tracking]:
    """Tracking of the five-bar that starts on its desired motion."""
    scene = load_scene("five_bar/tracking", overrides)
    law = build_scene_controller(scene, load("five_bar"))
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
def test_the_offset_along_a_motion_matches_a_run(overrides: dict[str, Any], rel: float) -> None:
    """Deviations by samples, delay, another model and friction, up to nonlinear terms."""
    on_it, law = start_on_motion(waves(6.0) | overrides, 2.0)
    result, run = check_stability("five_bar/tracking", on_it), simulate("five_bar/tracking", on_it)
    expected = np.array([law.desired(float(t))[0] for t in run.t])
    off = np.abs(run.q_tree[:, [0, 2]] - expected).max(axis=0)
    assert off.max() > 1e-3
    assert result.offset == pytest.approx(off, rel=rel)
    assert result.stable


def test_stability_of_a_run_far_off_the_desired_motion_is_unknown() -> None:
    """Errors decay along the desired motion, but the run is elsewhere."""
    result = check_stability(
        "five_bar/tracking", waves(6.0) | {"friction_smoothing": 0.2, "joint.theta_1.friction": 5.0}
    )
    assert result.growth is not None
    assert result.growth < 1
    assert result.stable is None
    assert "because of sampling, delay, friction or the controller's model" in str(result.reason)


@pytest.mark.parametrize(
    ("name", "sampling"),
    [("five_bar/set_point", {"sample_time": 1e-3, "delay": 0.21}), ("five_bar/tracking", {"sample_time": 1e-4})],
)
def test_stability_with_too_many_samples_is_unknown(name: str, sampling: dict[str, float]) -> None:
    result = check_stability(name, {f"controller.{key}": x for key, x in sampling.items()})
    assert result.stable is None
    assert "samples" in str(result.reason)
