"""`ckc sensitivities`: JSON keys and shapes, summary, files, exit codes, and invalid arguments."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from tests.contract.helpers.bad import Bad, expect
from tests.contract.helpers.command import ckc

SCENE, NAMES = "five_bar/set_point", ("controller.K_P", "joint.theta_2.xyz.x", "gravity")
SHORT_RUN = ("--set", "t_end=0.2")


def test_json_has_the_documented_keys_and_shapes() -> None:
    answer = ckc("sensitivities", SCENE, *NAMES, *SHORT_RUN, "--json")
    assert (answer.code, answer.err) == (0, "")
    result = answer.json
    m, p = len(result["t"]), 5
    assert result["parameters"] == [*NAMES[:2], "gravity.x", "gravity.y", "gravity.z"]
    for key, width in (("q_tree", 4), ("v_tree", 4), ("u", 2), ("tau", 2)):
        assert np.shape(result[key]) == (m, width, p)
    assert {name: np.shape(x) for name, x in result["points"].items()} == {"tip": (m, 3, p)}
    assert (result["status"], result["end_time"]) == ("done", None)
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith("| `sensitivities`"))
    assert [key for key in result if not re.search(rf"\b{key}\b", row)] == []


def test_summary_and_files(tmp_path: Path) -> None:
    answer = ckc("sensitivities", SCENE, *NAMES, *SHORT_RUN, "--out", str(tmp_path / "x"), "--figures")
    assert answer.code == 0
    result = ckc_pin.sensitivities(SCENE, NAMES, {"t_end": 0.2})
    largest = np.abs(result.of("theta_3", "controller.K_P")).max()
    assert f"theta_3 = {largest:.4g} rad/(N m/rad)" in " ".join(answer.out.split())
    assert repr(result).splitlines()[0] == "Sensitivities of five_bar/set_point, done: reached t_end"
    assert {path.name for path in (tmp_path / "x").iterdir()} == {"run.npz", "sensitivities.npz", "sensitivities.png"}
    with np.load(tmp_path / "x" / "sensitivities.npz", allow_pickle=False) as data:
        assert list(data["parameters"]) == list(result.parameters)
        for name in ("t", "q_tree", "v_tree", "u", "tau"):
            assert np.array_equal(data[name], getattr(result, name))
        assert np.array_equal(data["point_moved"][:, 0], result.points["tip"])
        assert json.loads(bytes(data["meta"]))["status"] == "done"
        page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "run_file.md").read_text(encoding="utf-8")
        section = page.partition("## sensitivities.npz")[2].partition("##")[0]
        assert [key for key in data if not re.search(rf"\b{key}\b", section)] == []


def test_run_without_derivative_saves_results_before_it(tmp_path: Path) -> None:
    answer = ckc(
        "sensitivities", "five_bar/friction", "initial.q_dot.theta_1", "--set", "initial.q_dot.theta_1=0",
        "--set", "joint.theta_1.friction=1e-3", "--out", str(tmp_path),
    )  # fmt: skip
    assert answer.code == 3
    assert "theta_1 begins to move from rest, and after a step in initial.q_dot.theta_1" in answer.err
    assert (tmp_path / "sensitivities.npz").is_file()


BAD = [
    Bad("no name", ["sensitivities", SCENE], ["NAME", "ckc sensitivities --help"]),
    Bad("unknown", ["sensitivities", SCENE, "link.rod.mass"], ["link.rod.mass", "link.link_2"]),
    Bad("no folder", ["sensitivities", SCENE, "gravity", "--figures"], ["--figures goes with --out DIR"]),
    Bad(
        "a drive",
        [
            "sensitivities",
            SCENE,
            "gravity",
            "--set",
            "controller.sample_time=0.01",
            "--set",
            "controller.drive.torque_resolution=0.1",
        ],
        ["controller.drive", "remove the table"],
    ),
]


@pytest.mark.parametrize("case", BAD, ids=lambda case: case.what)
def test_bad_input(case: Bad, bar: Path) -> None:
    expect(case, bar)
