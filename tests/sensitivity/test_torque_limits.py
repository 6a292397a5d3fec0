"""Sensitivities while motors on dependent joints are at their torque limits."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import simulate
from ckc_pin.mechanism.parameters import values_of
from ckc_pin.sensitivity.sensitivities import sensitivities
from tests.sensitivity.four_bar import TIGHT

TOLERANCE = 1e-6  # relative to the largest; the differences of this fast motion are accurate to 1e-7
PARTS = ("q_tree", "v_tree", "u", "tau")
MOTORS = """
[[motor]]
joint = "theta_1"
ratio = 2.0
[[motor]]
joint = "theta_2"
ratio = 3.0
torque_limit = 1.0
"""


def driven_elbow(folder: Path) -> str:
    """Write the five-bar with a motor on an elbow, a dependent joint, which is at its torque limit from the start."""
    shutil.copytree("urdf/five_bar", folder)
    path = folder / "mechanism.toml"
    text = path.read_text(encoding="utf-8").replace('actuated = ["theta_1", "theta_3"]\n', "")
    path.write_text(text + MOTORS, encoding="utf-8")
    return str(folder / "set_point.scene.toml")


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
@pytest.mark.parametrize("terms", ["pinocchio", "generated"])
def test_a_motor_on_a_dependent_joint_at_its_limit(formulation: str, terms: str, tmp_path: Path) -> None:
    """The other motor gives the same torque as without that limit."""
    scene = driven_elbow(tmp_path / "x")
    mechanism = ckc_pin.load(tmp_path / "x" / "mechanism.toml")
    values: dict[str, Any] = dict(values_of(mechanism.spec, mechanism.urdf))
    values |= {"gravity.y": -9.81, "joint.theta_2.xyz.x": values["joint.theta_2.xyz"][0], "controller.K_P": 10.0}
    values |= {"controller.K_V": 1.0, "initial.q_dot.theta_1": 0.0}
    names = ["link.link_2.mass", "gravity.y", "joint.theta_2.xyz.x", "controller.K_P", "controller.K_V"]
    names += ["motor.theta_1.ratio", "motor.theta_2.ratio", "motor.theta_2.torque_limit", "initial.q_dot.theta_1"]
    overrides = {**TIGHT, "formulation": formulation, "t_end": 0.05, "solver.output_dt": 0.01}
    result = sensitivities(scene, names, {**overrides, "solver.terms": terms})
    assert result.run.stats["terms"] == terms
    assert result.run.status == "done"
    assert np.all(np.abs(result.run.tau[:, 1]) == 1.0)

    def read(run: Any) -> Any:
        return np.concatenate([getattr(run, part) for part in PARTS], axis=1)

    ours = read(result)
    for k, name in enumerate(names):
        h = 1e-3 * max(0.3, abs(values[name]))
        one, two, four = (
            (read(simulate(scene, {**overrides, name: values[name] + x}))
             - read(simulate(scene, {**overrides, name: values[name] - x}))) / (2 * x)
            for x in (h, h / 2, h / 4)
        )  # fmt: skip
        expected = (16 * (4 * four - two) - (4 * two - one)) / 45
        assert np.abs(expected).max() > 1e-4, name
        assert np.abs(ours[:, :, k] - expected).max() <= TOLERANCE * np.abs(expected).max(), name


def test_a_torque_pole_has_no_derivative() -> None:
    """The DAE moves on where the controller's q stops being a chart. The requested torque changes its sign there."""
    scene = "tests/sensitivity/loops/torque_pole"
    tau = simulate(scene, {"solver.output_dt": 1e-3}).tau
    assert np.abs(np.diff(tau, axis=0)).max() == pytest.approx(2 * np.abs(tau).max())  # from limit to limit
    result = sensitivities(scene, ["motor.mot_a1.torque_limit"])
    assert result.run.status == "stopped"
    assert result.run.t[-1] == pytest.approx(0.7218, abs=1e-3)
    assert "the required motor torque passes through infinity and jumps from one limit" in result.run.message
