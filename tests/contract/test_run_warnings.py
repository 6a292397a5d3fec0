"""Warnings of a run: the same in Python, in its file, in the JSON and on the terminal; and causes of stops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Run, check, simulate
from tests.contract.helpers.command import ckc

SCENE = """
mechanism = "mechanism.toml"
formulation = "reduced"
t_end = 5.0
[initial.q]
theta_1 = -1.434
theta_3 = -1.707
[controller]
type = "tracking"
Lambda = 40.0
K_D = 5.0
"""
AWAY = """
[controller.desired.theta_1]
offset = -1.434
harmonics = [[2.0, 1.0, 0.0]]
[controller.desired.theta_3]
offset = -1.707
harmonics = [[2.0, -1.0, 0.0]]
"""
CIRCLE = """
[controller.desired]
point = "tip"
circle = {centre = [0.15, -0.3, 0.0], radius = 0.25, frequency = 1.0, phase = -1.57}
"""
LEAVES = "the desired trajectory leaves the workspace at t = 3.50634 s: theta_1, theta_3 cannot follow it from there"


def scene(bar: Path, text: str) -> str:
    (bar / "away.scene.toml").write_text(SCENE + text)
    return str(bar / "away.scene.toml")


def test_stop_names_the_instant_at_which_the_desired_motion_left(bar: Path) -> None:
    run = simulate(scene(bar, AWAY))
    assert run.status == "stopped"
    assert "the desired motion left the workspace at t = 3.5063 s; phi_z is singular" in run.message
    assert "so small" not in run.message
    assert run.warnings == (LEAVES,)
    assert set(run.warnings) <= set(check(scene(bar, AWAY)).warnings)


def test_stop_on_a_path_of_a_point_names_its_shape(bar: Path) -> None:
    """The tip reaches the outer edge of its workspace."""
    run = simulate(scene(bar, CIRCLE))
    assert run.status == "stopped"
    assert run.message.endswith(": the desired circle of the point 'tip' left the workspace at t = 0.3328 s")
    (warning,) = run.warnings
    assert warning.startswith("the desired trajectory leaves the workspace at t = 0.33284 s")


def test_sampled_run_beyond_the_end_of_a_path_is_kept_and_drawn(bar: Path, tmp_path: Path) -> None:
    """The sample after the exit is at 0.334 s, where the path of the point has no q_d and no Lyapunov function."""
    run = simulate(scene(bar, "sample_time = 0.002\n" + CIRCLE))
    assert run.status == "stopped"
    assert run.t[-1] == 0.334
    assert "the desired path of the point 'tip' leaves the workspace of its branch at t = 0.33284 s" in run.message
    assert run.lyapunov is not None
    assert np.isfinite(run.lyapunov[:-1]).all()
    assert np.isnan(run.lyapunov[-1])
    run.plot().save(tmp_path)
    assert list(tmp_path.glob("*.png"))


def test_warnings_are_the_same_everywhere(bar: Path) -> None:
    path = scene(bar, AWAY)
    answer = ckc("run", path, "--out", "kept", "--json")
    assert answer.code == 3
    assert answer.json["warnings"] == [LEAVES]
    assert f"warning: {LEAVES}" in " ".join(answer.err.split())
    loaded = Run.load("kept")
    assert loaded.warnings == (LEAVES,)
    assert loaded.to_dict()["warnings"] == [LEAVES]
    assert ("warning", LEAVES) in loaded.summary().rows


def test_model_and_start_warnings_travel(bar: Path) -> None:
    """A link without mass, a joint outside its limits and a configuration far from the guess."""
    urdf = bar / "five_bar.urdf"
    limits = '<limit lower="0.0" upper="1.0" effort="1" velocity="1"/>'
    urdf.write_text(urdf.read_text().replace('"theta_1" type="continuous">', f'"theta_1" type="revolute">{limits}'))
    run = simulate(str(bar / "swing.scene.toml"), {"t_end": 0.05})
    checked = check(str(bar / "swing.scene.toml"))
    (outside,) = [text for text in run.warnings if text.startswith("the start is outside joint limits: theta_1")]
    assert outside in checked.warnings
    (no_stops,) = [text for text in run.warnings if text.startswith("joint limits are not stops")]
    assert no_stops in checked.warnings
    assert set(ckc_pin.load(bar / "mechanism.toml").warnings) <= set(run.warnings)


def test_motor_above_its_speed_limit_is_a_warning(bar: Path) -> None:
    mechanism = (bar / "mechanism.toml").read_text().replace('actuated = ["theta_1", "theta_3"]', "")
    motors = '[[motor]]\njoint = "theta_1"\nspeed_limit = 0.001\n[[motor]]\njoint = "theta_3"\n'
    (bar / "mechanism.toml").write_text(mechanism + motors)
    run = simulate(str(bar / "set_point.scene.toml"), {"t_end": 0.2})
    (warning,) = run.warnings
    assert warning.startswith("theta_1 turns at ")
    assert warning.endswith(", its speed_limit is 0.001")
    assert [row for row in run.summary().rows if row[0] == "warning"] == [("warning", warning)]


@pytest.mark.parametrize("name", ["five_bar/tracking", "five_bar/swing", "delta"])
def test_runs_without_a_cause_have_no_warnings(name: str) -> None:
    assert simulate(name, {"t_end": 0.05}).warnings == ()


def test_warnings_are_kept_by_parts_of_a_run(bar: Path) -> None:
    assert simulate(scene(bar, AWAY)).sel(t=slice(0.0, 1.0)).warnings == (LEAVES,)
