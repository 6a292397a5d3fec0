"""`ckc report` on a user's scenes: output, files, and refused arguments."""

from __future__ import annotations

import csv
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin.cli import report as command
from tests.analysis.one_run import time_by_one_run
from tests.analysis.swing_table import SCENE, pendulum, write_table
from tests.contract.helpers.command import Outcome, ckc
from tests.contract.helpers.under_way import under_way

ANSWER = {"status", "message", "scenes", "written"}
SECTION = {"scene", "status", "message", "reference", "model_difference", "rows", "advice", "notes", "seconds"}
REFERENCE = {"of", "confirmed_by", "rtol", "accuracy", "t_end", "t", "q_tree", "v_tree"}
ROW = """program formulation method rtol dt overrides status reason error error_q error_v resolved rhs steps used wall_s
         setup_s"""
ADVICE = {"target", "set", "remove", "reason", "wall_s", "error", "mujoco"}


@pytest.fixture(scope="module", autouse=True)
def one_run() -> Iterator[None]:
    """Time each setting by one run: no test here depends on how exact the times are."""
    with time_by_one_run():
        yield


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_table(tmp_path / "table")


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """Return what `ckc report table` prints."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("printed"))
        return ckc("report", write_table(Path("table")).name, "--budget", "5")


@pytest.fixture
def no_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None)


def test_json_of_a_users_scene(table: Path) -> None:
    answer = ckc("report", "table/default.scene.toml", "--budget", "5", "--json")
    assert (answer.code, answer.err) == (0, "")
    data = answer.json
    assert set(data) == ANSWER
    assert (data["status"], data["message"], data["written"]) == ("done", "", [])
    (section,) = data["scenes"]
    assert set(section) == SECTION
    assert section["scene"] == "table/default.scene.toml"
    assert set(section["reference"]) == REFERENCE
    q_tree, _ = pendulum(np.array(section["reference"]["t"]))
    assert np.abs(np.array(section["reference"]["q_tree"]) - q_tree).max() < 1e-11
    assert all(list(row) == ROW.split() for row in section["rows"])
    assert {row["program"] for row in section["rows"]} == {"ckc_pin", "MuJoCo"}
    assert all(set(advice) == ADVICE for advice in section["advice"])
    assert [advice["target"] for advice in section["advice"]] == [1e-3, 1e-6, 1e-9]


def test_advised_options_can_be_pasted_into_run(table: Path, no_mujoco: None, printed: Outcome) -> None:
    section = ckc("report", "table", "--budget", "5", "--json").json["scenes"][0]
    assert "for an error of 1e-03: --set formulation=" in printed.out
    for advice in section["advice"][:2]:
        options = [word for option in advice["set"] for word in ("--set", option)]
        run = ckc("run", "table", *options, "--json").json
        q_tree, _ = pendulum(np.array([0.0, 1.5]))
        assert np.abs(np.array(run["q_tree"]) - q_tree[-1]).max() <= advice["target"]


def test_terminal_output_has_table_notes_and_advice(printed: Outcome) -> None:
    assert (printed.code, printed.err) == (0, "")
    for words in (
        "shortest time (ms) within an error of",
        "reduced, auto",
        "spf, z, Radau",
        "MuJoCo, RK4, solref 2 dt",
        "confirmed by",
        "loops are soft constraints in MuJoCo",
    ):
        assert words in printed.out
    assert max(map(len, printed.out.split("reference:")[0].splitlines())) <= 80


def test_folder_has_page_rows_and_figures(table: Path) -> None:
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


def test_long_reports_are_announced(table: Path, no_mujoco: None) -> None:
    quick = ckc("report", "table", "--set", "t_end=0.01", "--budget", "10")
    assert quick.err == ""
    several = ckc("report", "table", "table", "--set", "t_end=0.01", "--budget", "5.5")
    assert several.err == "this may take 11 s, 5.5 s for each of 2 scenes; --budget SECONDS changes that\n"


def test_report_without_mujoco_has_a_note(table: Path, no_mujoco: None) -> None:
    section = ckc("report", "table", "--budget", "2", "--json").json["scenes"][0]
    assert {row["program"] for row in section["rows"]} == {"ckc_pin"}
    assert any("MuJoCo is not compared: not installed" in note for note in section["notes"])


def test_loop_without_mujoco_equality_is_noted(table: Path) -> None:
    text = (table / "mechanism.toml").read_text(encoding="utf-8")
    text = text.replace('"point_2d"', '"cylindrical"').replace("axis_a", "axis_b = [0.0, 1.0, 0.0]\naxis_a")
    (table / "mechanism.toml").write_text(text, encoding="utf-8")
    section = ckc("report", "table", "--budget", "2", "--json").json["scenes"][0]
    assert {row["program"] for row in section["rows"]} == {"ckc_pin"}
    assert any("MuJoCo has no equality constraint for type 'cylindrical'" in note for note in section["notes"])


def test_missing_reference_stops_and_writes_the_page(table: Path, no_mujoco: None) -> None:
    """A budget of 1e-6 s is too short to confirm a reference."""
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
        (["table", "--budget", "0"], "--budget 0: expected a number of seconds above zero"),
        (["table", "--budget", "nan"], "--budget nan: expected a number of seconds above zero"),
        (["table", "--budget", "inf"], "--budget inf: expected a number of seconds above zero"),
        (["table", "--budget", "long"], "'long' is not a valid float"),
        (["table", "--out", "table/table.urdf"], "--out table/table.urdf: no folder"),
        (["table", "broken"], "theta"),
    ],
)
def test_invalid_arguments_are_refused_before_any_run(
    words: list[str], says: str, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError("a scene was run")

    broken = write_table(table.parent / "broken", SCENE + "theta = 1.0\n")
    assert broken.is_dir()
    monkeypatch.setattr("ckc_pin.analysis.precision.work_precision", fail)
    answer = ckc("report", *words, "--json")
    assert answer.code == 2
    assert answer.json["status"] == "error"
    assert says in answer.json["message"]
    assert "Traceback" not in answer.err


# The command in its own process. It prints "under way" to standard error after ten settings.
CKC = """
import sys
import ckc_pin.cli
from ckc_pin.analysis.precision import compute
compare_motions, calls = compute.compare_motions, []

def count_calls(*arguments):
    calls.append(arguments)
    if len(calls) == 10:
        print("under way", file=sys.stderr, flush=True)
    return compare_motions(*arguments)

compute.compare_motions = count_calls
ckc_pin.cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
def test_interrupted_report_is_printed_and_saved(number: signal.Signals, code: int, table: Path) -> None:
    words = ["report", "table", "five_bar/swing", "--budget", "500", "--json", "--out", "out"]
    with under_way(CKC, *words) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("this may take 1000 s")
        assert process.stderr.readline() == "under way\n"
        process.send_signal(number)
        out, _ = process.communicate(timeout=120)
    assert process.returncode == code
    data = json.loads(out)
    assert data["status"] == "interrupted"
    (section,) = data["scenes"]
    assert 9 <= len(section["rows"]) < 136
    with Path("out/rows.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(section["rows"])
