"""Bad input to `calibrate` gives one clear message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, calibrate
from tests.identification.closed_form_five_bar import LENGTHS, columns, draw_motors, read

READINGS = read(np.array([0.2801, 0.3040, 0.2790, 0.3055, 0.3048]), draw_motors(np.random.default_rng(0), 12))
ENCODERS = columns(READINGS, ("theta_1", "theta_2", "theta_3", "theta_4"))
TIP = columns(READINGS, ("theta_1", "theta_3", "tip.x", "tip.y"))
NAMES = list(LENGTHS)[:4]

FOLDED = {**ENCODERS, "theta_2": -ENCODERS["theta_2"], "theta_4": -ENCODERS["theta_4"]}
DEGREES = {name: np.degrees(x) for name, x in ENCODERS.items()}

CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "nothing": (lambda: calibrate("five_bar", ENCODERS, []), "nothing to calibrate"),
    "type": (lambda: calibrate("five_bar", ENCODERS, [3]), "expected names of parameters"),  # type: ignore[list-item]
    "unknown parameter": (
        lambda: calibrate("five_bar", ENCODERS, ["joint.theta_9.xyz.x"]),
        "nothing is called 'joint.theta_9",
    ),
    "unknown pattern": (
        lambda: calibrate("five_bar", ENCODERS, ["joint.*.length"]),
        r"there are joint.\*.xyz, joint.\*.rpy",
    ),
    "mass": (lambda: calibrate("five_bar", ENCODERS, ["link.link_1.mass"]), "no influence on positions"),
    "encoder": (lambda: calibrate("five_bar", TIP, ["encoder.theta_2.offset"]), "did you mean 'encoder.theta_1"),
    "reading": (lambda: calibrate("five_bar", {"theta_7": [0.0]}, NAMES), "no reading 'theta_7'; there are theta_1"),
    "no poses": (lambda: calibrate("five_bar", {"theta_1": []}, NAMES), "there are no readings"),
    "ragged": (lambda: calibrate("five_bar", {**ENCODERS, "theta_2": [0.1, 0.2]}, NAMES), "theta_2: expected finite"),
    "text": (lambda: calibrate("five_bar", {**ENCODERS, "theta_2": ["a"] * 12}, NAMES), "theta_2: expected numbers"),
    "infinite": (lambda: calibrate("five_bar", {**ENCODERS, "theta_2": [np.inf] * 12}, NAMES), "expected finite"),
    "too few readings": (
        lambda: calibrate("five_bar", {k: ENCODERS[k] for k in ("theta_1", "theta_3")}, NAMES),
        "has 2 freedoms; measure more than 2",
    ),
    "too few poses": (
        lambda: calibrate("five_bar", {k: x[:1] for k, x in ENCODERS.items()}, NAMES),
        "measure at least 2 poses",
    ),
    "degrees": (lambda: calibrate("five_bar", DEGREES, NAMES), "look like degrees"),
    "degrees, with a point": (
        lambda: calibrate("five_bar", {k: x if "tip" in k else np.degrees(x) for k, x in TIP.items()}, NAMES),
        "theta_1, theta_3 look like degrees",
    ),
    "other branch": (
        lambda: calibrate("five_bar", FOLDED, NAMES),
        "cannot follow the readings.*another assembly branch",
    ),
    "redundant rows": (lambda: calibrate("bricard", bricard_poses(), ["joint.*.rpy"]), "redundant"),
    "noise": (lambda: calibrate("five_bar", ENCODERS, NAMES, noise={"theta_1": 0.0}), "expected a positive number"),
    "noise of nothing": (
        lambda: calibrate("five_bar", ENCODERS, NAMES, noise={"tip.x": 1.0}),
        "nothing is called 'tip.x'",
    ),
    "prior": (lambda: calibrate("five_bar", ENCODERS, NAMES, prior={"gravity": 1.0}), "nothing is called 'gravity'"),
    "loss": (lambda: calibrate("five_bar", ENCODERS, NAMES, loss="l1"), "loss: expected 'squares' or 'huber'"),
    "tracker": (lambda: calibrate("five_bar", ENCODERS, NAMES, tracker="unknown"), "needs readings of a point"),
    "tracker without z": (lambda: calibrate("five_bar", TIP, NAMES, tracker="unknown"), "x, y and z of a point"),
    "no file": (lambda: calibrate("five_bar", "nowhere.csv", NAMES), "nowhere.csv: cannot be read"),
}  # fmt: skip


def bricard_poses() -> dict[str, Any]:
    from ckc_pin import load

    mechanism = load("bricard")
    row = mechanism.tree.to_coordinates(mechanism.q_tree)
    return {name: np.full(30, x) for name, x in zip(mechanism.coordinates, row, strict=True)}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gives_one_message(case: str) -> None:
    call, message = CASES[case]
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("theta_1,theta_1\n1,2\n", "names a column twice"),
        ("theta_1,theta_2\n1\n", "row 2 has 1 cells"),
        ("theta_1,theta_2\n1,b\n", "expected numbers below"),
        ("", "there are no readings"),
    ],
)
def test_bad_csv_gives_one_message(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        calibrate("five_bar", tmp_path / "poses.csv", NAMES)
