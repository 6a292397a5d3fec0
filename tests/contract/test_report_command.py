"""`ckc report`: what it prints and writes of a person's own scenes, and what it refuses."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin.cli import report as command
from tests.analysis.swing_table import SCENE, pendulum, write_table
from tests.contract.helpers.command import ckc
from tests.contract.helpers.under_way import under_way

PLAIN = {"status", "message", "scenes", "written"}
SECTION = {"scene", "status", "message", "reference", "model_difference", "rows", "advice", "notes", "seconds"}
REFERENCE = {"of", "confirmed_by", "rtol", "accuracy", "t_end", "t", "q_tree", "v_tree"}
ROW = """program formulation method rtol dt overrides status reason error error_q error_v resolved rhs steps used wall_s
         setup_s"""
ADVICE = {"target", "set", "remove", "reason", "wall_s", "error", "mujoco"}


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_table(tmp_path / "table")


@pytest.fixture
def no_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None)


def test_json_of_ones_own_scene(table: Path) -> None:
    answer = ckc("report", "table/default.scene.toml", "--budget", "5", "--json")
    assert (answer.code, answer.err) == (0, "")
    found = answer.json
    assert set(found) == PLAIN
    assert (found["status"], found["message"], found["written"]) == ("done", "", [])
    (section,) = found["scenes"]
    assert set(section) == SECTION
    assert section["scene"] == "table/default.scene.toml"
    assert set(section["reference"]) == REFERENCE
    q_tree, _ = pendulum(np.array(section["reference"]["t"]))
    assert np.abs(np.array(section["reference"]["q_tree"]) - q_tree).max() < 1e-11
    assert all(list(row) == ROW.split() for row in section["rows"])
    assert {row["program"] for row in section["rows"]} == {"ckc_pin", "MuJoCo"}
    assert all(set(advice) == ADVICE for advice in section["advice"])
    assert [advice["target"] for advice in section["advice"]] == [1e-3, 1e-6, 1e-9]


def test_the_advice_can_be_pasted(table: Path, no_mujoco: None) -> None:
    found = ckc("report", "table", "--budget", "5", "--json").json["scenes"][0]
    said = ckc("report", "table", "--budget", "5").out
    assert "for an error of 1e-03: --set formulation=" in said
    for advice in found["advice"][:2]:
        options = [word for option in advice["set"] for word in ("--set", option)]
        run = ckc("run", "table", *options, "--json").json
        q_tree, _ = pendulum(np.array([0.0, 1.5]))
        assert np.abs(np.array(run["q_tree"]) - q_tree[-1]).max() <= advice["target"]


def test_for_people(table: Path) -> None:
    answer = ckc("report", "table", "--budget", "5")
    assert (answer.code, answer.err) == (0, "")
    for words in (
        "least time (ms) to an error of",
        "reduced, auto",
        "spf, z, Radau",
        "MuJoCo, RK4, solref 2 dt",
        "confirmed by",
        "loops are soft constraints in MuJoCo",
    ):
        assert words in answer.out
    assert max(map(len, answer.out.split("reference:")[0].splitlines())) <= 80


def test_the_folder_has_page_rows_and_figure(table: Path) -> None:
    answer = ckc("report", "table", "five_bar/swing", "--budget", "3", "--set", "t_end=0.2", "--out", "out", "--json")
    assert answer.code == 0
    written = [Path(path) for path in answer.json["written"]]
    names = ["rows.csv", "report.md", "work_precision_1_table.png", "work_precision_2_five_bar_swing.png"]
    assert sorted(path.name for path in written) == sorted(names) == sorted(p.name for p in Path("out").iterdir())
    with Path("out/rows.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    rows = [(section["scene"], row) for section in answer.json["scenes"] for row in section["rows"]]
    assert len(lines) == len(rows)
    for line, (scene, row) in zip(lines, rows, strict=True):
        assert (line["scene"], line["method"], line["status"]) == (scene, row["method"], row["status"])
        assert (float(line["error"]) if line["error"] else None) == row["error"]
    page = Path("out/report.md").read_text(encoding="utf-8")
    for section in answer.json["scenes"]:
        assert f"\n## {section['scene']}\n" in page
        for advice in section["advice"]:
            assert all(f"--set {option}" in page for option in advice["set"])
    assert all(f"]({name})" in page for name in names[2:])
    for name in names[2:]:
        assert Path("out", name).read_bytes().startswith(b"\x89PNG")


def test_one_scene_has_one_figure(table: Path, no_mujoco: None) -> None:
    assert ckc("report", "table", "--budget", "2", "--out", "out").code == 0
    assert {path.name for path in Path("out").iterdir()} == {"report.md", "rows.csv", "work_precision.png"}


def test_what_takes_long_is_announced(table: Path, no_mujoco: None) -> None:
    quick = ckc("report", "table", "--set", "t_end=0.01", "--budget", "10")
    assert quick.err == ""
    several = ckc("report", "table", "table", "--set", "t_end=0.01", "--budget", "5.5")
    assert several.err == "this may take 11 s, 5.5 s for each of 2 scenes; --budget SECONDS changes that\n"


def test_without_mujoco(table: Path, no_mujoco: None) -> None:
    section = ckc("report", "table", "--budget", "2", "--json").json["scenes"][0]
    assert {row["program"] for row in section["rows"]} == {"ckc_pin"}
    assert any("MuJoCo is not beside it: not installed" in note for note in section["notes"])


def test_a_loop_that_mujoco_does_not_have(table: Path) -> None:
    text = (table / "mechanism.toml").read_text(encoding="utf-8")
    text = text.replace('"point_2d"', '"cylindrical"').replace("axis_a", "axis_b = [0.0, 1.0, 0.0]\naxis_a")
    (table / "mechanism.toml").write_text(text, encoding="utf-8")
    section = ckc("report", "table", "--budget", "2", "--json").json["scenes"][0]
    assert {row["program"] for row in section["rows"]} == {"ckc_pin"}
    assert any("MuJoCo has no equality for type 'cylindrical'" in note for note in section["notes"])


def test_no_reference_is_a_stop_and_the_other_scenes_are_kept(table: Path, no_mujoco: None) -> None:
    """Nobody confirms a motion within a budget that is none."""
    answer = ckc("report", "table", "--budget", "1e-6", "--json", "--out", "out")
    assert answer.code == 3
    assert answer.json["status"] == "stopped"
    assert "no reference could be confirmed" in answer.json["message"]
    assert answer.err == f"{answer.json['message']}\n"
    assert Path("out/report.md").read_text(encoding="utf-8").count("no reference could be confirmed") == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "ckc report: Missing argument 'SCENE...'"),
        (["nowhere"], "no mechanism 'nowhere'; shipped: "),
        (["table", "five_bar/swng"], "five_bar has no scene 'swng'"),
        (["table", "--set", "solver.rtoll=1"], "unknown key 'rtoll'"),
        (["table", "--budget", "0"], "--budget 0: a number of seconds above zero"),
        (["table", "--budget", "nan"], "--budget nan: a number of seconds above zero"),
        (["table", "--budget", "inf"], "--budget inf: a number of seconds above zero"),
        (["table", "--budget", "long"], "'long' is not a valid float"),
        (["table", "--out", "table/table.urdf"], "--out table/table.urdf: no folder"),
        (["table", "broken"], "theta"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_run(
    words: list[str], says: str, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("it was run")

    broken = write_table(table.parent / "broken", SCENE + "theta = 1.0\n")
    assert broken.is_dir()
    monkeypatch.setattr("ckc_pin.analysis.precision.work_precision", never)
    answer = ckc("report", *words, "--json")
    assert answer.code == 2
    assert answer.json["status"] == "error"
    assert says in answer.json["message"]
    assert "Traceback" not in answer.err


# The command, in a process of its own, which says on standard error when it has ten rows.
CKC = """
import sys
import ckc_pin.cli
from ckc_pin.analysis.precision import compute
apart, compared = compute.apart, []

def announced(*arguments):
    compared.append(arguments)
    if len(compared) == 10:
        print("under way", file=sys.stderr, flush=True)
    return apart(*arguments)

compute.apart = announced
ckc_pin.cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
def test_an_interrupted_report_is_printed_and_saved(number: signal.Signals, code: int, table: Path) -> None:
    words = ["report", "table", "five_bar/swing", "--budget", "500", "--json", "--out", "out"]
    with under_way(CKC, *words) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("this may take 1000 s")
        assert process.stderr.readline() == "under way\n"
        process.send_signal(number)
        out, _ = process.communicate(timeout=120)
    assert process.returncode == code
    found = json.loads(out)
    assert found["status"] == "interrupted"
    (section,) = found["scenes"]
    assert 9 <= len(section["rows"]) < 136
    with Path("out/rows.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(section["rows"])
