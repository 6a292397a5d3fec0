"""Measurements that cannot be used, through ckc identify: one message each, which names the place and a remedy."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.contract.helpers.command import ckc
from tests.identification.test_torques import record


def backwards(data):
    t = data["t"].copy()
    t[500] = t[400]
    return {**data, "t": t}


CASES = {
    "a missing coordinate": (
        lambda data: {name: x for name, x in data.items() if name != "theta_3"},
        "swing.csv: no column theta_3; 2 coordinates and the torque",
    ),
    "a missing torque": (
        lambda data: {name: x for name, x in data.items() if name != "tau.theta_3"},
        "swing.csv: no column tau.theta_3; 2 coordinates and the torque",
    ),
    "another name": (
        lambda data: {"q_1" if name == "theta_1" else name: x for name, x in data.items()},
        'theta_3, tau.theta_1, tau.theta_3, q_1; names = {"theta_1" = "COLUMN"}',
    ),
    "time running backwards": (backwards, "swing.csv: t does not increase: 1.996 is followed by 1.6 (value 501)"),
    "few values": (
        lambda data: {name: x[:5] for name, x in data.items()}, "swing.csv: theta_1: 5 values; at least 16"
    ),
    "no values": (
        lambda data: {**data, "theta_1": np.full(len(data["t"]), np.nan)}, "swing.csv: theta_1: 0 values; at least 16"
    ),
    "degrees": (
        lambda data: {**data, "theta_3": np.degrees(data["theta_3"])},
        'swing.csv: theta_3 reaches 82.38 rad; if these are degrees, give units = {theta_3 = "deg"}',
    ),
    "another branch": (
        lambda data: {**data, "theta_1": data["theta_1"] + 3.0},
        "at the first instant the loops do not let the mechanism follow the measured coordinates; they are of another "
        "branch (q_guess in the mechanism's file chooses it) or another mechanism",
    ),
}  # fmt: skip


def run(data, folder: Path, method: str, mechanism: str = "five_bar") -> str:
    np.savetxt(folder / "swing.csv", np.array(list(data.values())).T, delimiter=",", header=",".join(data), comments="")
    file = folder / "arm.identify.toml"
    file.write_text(
        f'mechanism = "{mechanism}"\n[[data]]\nfile = "swing.csv"\n'
        f'[estimate]\nmethod = "{method}"\nparameters = ["link.*.inertial"]\n'
    )
    done = ckc("identify", str(file), "--out", str(folder / "o"))
    assert done.code == 2
    assert not (folder / "o").exists() or not list((folder / "o").iterdir())
    message = " ".join(done.err.split())
    assert message.startswith("error: ")
    assert message.count("error") == 1
    return message


@pytest.mark.parametrize("method", ["torques", "motion"])
@pytest.mark.parametrize("case", CASES)
def test_unusable_measurements_have_one_message(case, method, tmp_path):
    spoil, expected = CASES[case]
    assert expected in run(spoil(record("five_bar")), tmp_path, method)


@pytest.mark.parametrize(("method", "expected"), [
    ("torques", "32 equations for 40 unknowns; record a longer motion"),
    ("motion", "40 measurements for 44 unknowns; record a longer motion"),
])  # fmt: skip
def test_fewer_data_than_parameters_have_one_message(method, expected, tmp_path):
    assert expected in run({name: x[:20] for name, x in record("five_bar").items()}, tmp_path, method)


def test_saturated_motor_is_named(tmp_path):
    limit = 0.05
    data = record("five_bar")
    data["tau.theta_1"] = np.clip(data["tau.theta_1"], -limit, limit)
    robot = tmp_path / "robot"
    shutil.copytree(Path(__file__).parents[2] / "urdf" / "five_bar", robot)
    text = (robot / "mechanism.toml").read_text().replace('actuated = ["theta_1", "theta_3"]', "")
    motors = [f'[[motor]]\nname = "{name}"\njoint = "{name}"\ntorque_limit = {bound}\n'
              for name, bound in (("theta_1", limit), ("theta_3", 100.0))]  # fmt: skip
    (robot / "mechanism.toml").write_text("\n".join([text, *motors]))
    message = run(data, tmp_path, "torques", mechanism="robot/mechanism.toml")
    assert "swing.csv: tau.theta_1 is at its limit, -0.05 to 0.05, most of the time" in message
    assert "record a slower motion, or correct torque_limit" in message
