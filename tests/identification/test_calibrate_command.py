"""The command calibrate: files, options, and messages."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import calibrate, load
from tests.contract.helpers.command import ckc
from tests.identification.closed_form_five_bar import LENGTHS, columns, draw_motors, read

NAMES = list(LENGTHS)[:4]
READINGS = read(np.array([0.2801, 0.3040, 0.2790, 0.3055, 0.3048]), draw_motors(np.random.default_rng(0), 12))
FILE = """mechanism = "five_bar"
poses = "poses.csv"
units = {theta_1 = "deg"}
[estimate]
parameters = NAMES
noise = {"theta_*" = 1e-4}
prior = {"joint.*.xyz" = 0.01}
""".replace("NAMES", json.dumps(NAMES))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    poses = columns(READINGS, ("theta_1", "theta_2", "theta_3", "theta_4"))
    scaled = [np.degrees(x) if name == "theta_1" else x for name, x in poses.items()]
    np.savetxt(tmp_path / "poses.csv", np.array(scaled).T, delimiter=",", header=",".join(poses), comments="")
    (tmp_path / "arm.calibrate.toml").write_text(FILE)
    return tmp_path / "arm.calibrate.toml"


def test_command_writes_result_and_parameters(file: Path, tmp_path: Path) -> None:
    done = ckc("calibrate", str(file), "--out", str(tmp_path / "o"), "--json")
    assert done.code == 0
    assert json.loads((tmp_path / "o" / "calibration.json").read_text()) == done.json
    poses = columns(READINGS, ("theta_1", "theta_2", "theta_3", "theta_4"))
    expected = calibrate("five_bar", poses, NAMES, noise=1e-4, prior={"joint.*.xyz": 0.01})
    values = tomllib.loads((tmp_path / "o" / "parameters.toml").read_text())["parameters"]
    assert values == pytest.approx(expected.overrides, abs=1e-9)
    assert done.json["parameters"][NAMES[0]]["verdict"] == expected.parameters[NAMES[0]].verdict
    assert load("five_bar", values).d == 2


def test_set_and_unset_override_keys_of_the_file(file: Path) -> None:
    free = ckc("calibrate", str(file), "--unset", "estimate.prior", "--set", "estimate.noise.theta_1=1e-3", "--json")
    assert free.json["noise"]["theta_1"] == 1e-3
    fixed = ckc("calibrate", str(file), "--set", "joint.theta_2.xyz.x=0.28", "--json")
    assert fixed.json["parameters"]["joint.theta_2.xyz.x"]["start"] == 0.28
    text = ckc("calibrate", str(file))
    assert "Calibration of five_bar from 12 poses" in text.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "estimate.loss=l1"], "estimate.loss"),
        (["--set", "units.theta_9=deg"], "units: theta_9: no such column; there are theta_1, theta_2"),
        (["--set", "units.theta_1=grad"], "units: theta_1: no unit 'grad'; there are s, ms"),
        (["--set", "poses=none.csv"], "none.csv: cannot be read"),
        (["--unset", "estimate.nois"], "a calibration has no such key to remove"),
        (["--unset", "estimate.parameters"], "estimate: the key 'parameters' is missing"),
    ],
)
def test_bad_input_has_one_message(file: Path, options: list[str], message: str) -> None:
    done = ckc("calibrate", str(file), *options)
    assert done.code == 2
    assert message in " ".join(done.err.split())
