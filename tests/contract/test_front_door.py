"""First steps with the commands: `ckc new`, completion, where results are saved, help."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Run, check, load, simulate
from ckc_pin.cli import output
from ckc_pin.cli.app import COMMANDS
from ckc_pin.cli.output import ProgressBar, Spinner
from tests.contract.helpers.command import Outcome, ckc

SHORT_RUN = ("--set", "t_end=0.01")


def program(*words: str, **more: str) -> subprocess.CompletedProcess[str]:
    whole = [sys.executable, "-m", "ckc_pin", *words]
    return subprocess.run(whole, capture_output=True, text=True, check=False, env={**os.environ, **more})


# --- how it is called --------------------------------------------------------------------------------


def test_version_and_python_m_ckc_pin() -> None:
    assert ckc("--version").out == f"ckc {ckc_pin.__version__}\n"
    result = program("--version")
    assert (result.returncode, result.stdout) == (0, f"ckc {ckc_pin.__version__}\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shell_completion_scripts_are_printed(shell: str) -> None:
    result = program(_CKC_COMPLETE=f"{shell}_source")
    assert result.returncode == 0
    assert f"_CKC_COMPLETE={shell}_complete" in result.stdout


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ckc in", {"plain,inverse"}),
        ("ckc run five_bar/t", {"plain,five_bar/tracking", "file,five_bar/t"}),
        ("ckc check delt", {"plain,delta", "plain,delta/default", "plain,delta/circle"}),
        ("ckc terms ste", {"plain,stewart"}),
        ("ckc map five_bar --sp", {"plain,--space"}),
        ("ckc map five_bar --space c", {"plain,cartesian"}),
        ("ckc play ru", {"file,ru"}),
    ],
)
def test_shipped_names_are_completed(line: str, expected: set[str]) -> None:
    words = line.split()
    result = program(_CKC_COMPLETE="bash_complete", COMP_WORDS=line, COMP_CWORD=str(len(words) - 1))
    assert result.returncode == 0
    assert set(result.stdout.splitlines()) >= expected


# --- a folder of one's own ---------------------------------------------------------------------------


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    answer = ckc("new", "mine")
    assert (answer.code, answer.err) == (0, "")
    *written, last = answer.out.splitlines()
    assert written == [f"written: mine/{name}" for name in ("mine.urdf", "default.scene.toml", "mechanism.toml")]
    assert last == "next: cd mine && ckc run ."
    return tmp_path / "mine"


def test_new_folder_can_be_run_from_inside(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mine)
    answer = ckc("run", ".", "--out", "first")
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.startswith("Run of mine, done: reached t_end\n")
    assert answer.out.endswith("written to first\n")
    run = Run.load("first")
    assert run.mechanism.name == "mine"
    assert np.ptp(run["shoulder"]) > 1.0, "it moves"
    assert np.abs(run.energy - run.energy[0]).max() < 1e-6
    result = check(mine)
    assert (result.n, result.d, result.warnings) == (3, 1, ())
    assert ckc("check", ".").code == 0


def test_new_mechanism_agrees_with_closed_form_assembly(mine: Path) -> None:
    """Rod and rocker meet: two circles, of 0.6 m about the crank's end and of 0.4 m about the hip."""
    run = simulate(mine)
    crank = 0.2 * np.stack([np.cos(run["shoulder"]), np.sin(run["shoulder"])], axis=1)
    hip = np.array([0.5, 0.0])
    knee = run.points["knee"][:, :2]
    assert np.abs(np.linalg.norm(knee - crank, axis=1) - 0.6).max() < 1e-9
    assert np.abs(np.linalg.norm(knee - hip, axis=1) - 0.4).max() < 1e-9
    rocker = hip + 0.4 * np.stack([np.cos(run["hip"]), np.sin(run["hip"])], axis=1)
    assert np.abs(knee - rocker).max() < 1e-9


def test_commented_lines_of_new_files_are_valid(mine: Path) -> None:
    path = mine / "default.scene.toml"
    text = path.read_text(encoding="utf-8")
    head, mark, rest = text.partition("# [controller]")
    assert mark
    path.write_text(head + re.sub(r"^# ", "", mark + rest, flags=re.MULTILINE), encoding="utf-8")
    run = simulate(mine, {"t_end": 10.0})
    assert run["shoulder"][-1] == pytest.approx(1.0, abs=1e-3)


def test_new_replaces_no_file(mine: Path, tmp_path: Path) -> None:
    answer = ckc("new", "mine", "--json")
    assert answer.code == 2
    assert "is there already; give another name" in answer.json["message"]
    for name in ("a b", "x/../*", "-", "ü"):
        answer = ckc("new", "--", name)
        assert answer.code == 2
        assert "a name consists of letters, digits, - and _" in answer.err
    answer = ckc("new", "")
    assert (answer.code, answer.err) == (2, "error: NAME is empty; give a name\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    inside = ckc("new", str(tmp_path / "robots" / "arm-2"), "--json")
    assert len(inside.json["written"]) == 3
    assert load(tmp_path / "robots" / "arm-2").name == "arm-2"


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["run", "five_bar/swing", "--set", "t_end=0.01", "--out", ""], "--out"),
        (["export", "five_bar", "--to", "mjcf", "--out", ""], "--out"),
        (["linearize", "five_bar", "--at", "equilibrium", "--out", ""], "--out"),
        (["sweep", "mine.sweep.toml", "--out", ""], "--out"),
        (["play", ""], "RUN..."),
        (["plot", ""], "RUN..."),
        (["sweep", "", "--out", "o"], "FILE"),
        (["import", ""], "FILE"),
    ],
)
def test_empty_path_is_rejected(words: list[str], what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    answer = ckc(*words)
    assert (answer.code, answer.err) == (2, f"error: {what} is empty; give a name\n")
    assert list(tmp_path.iterdir()) == []


def test_html_and_gif_paths_must_not_be_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    simulate("five_bar/swing", {"t_end": 0.01}).save("o")
    answer = ckc("play", "o", "--html", ".")
    assert (answer.code, answer.err) == (2, "error: .: expected the name of a file, got a folder\n")


def test_start_by_dependent_coordinates_names_the_independent_ones(mine: Path) -> None:
    mechanism = mine / "mechanism.toml"
    mechanism.write_text(mechanism.read_text().replace("independent =", "# independent ="))
    (chosen,) = check(mechanism).independent
    (mine / "own.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 1.0\n[initial.q]\n'
    )
    other = next(name for name in ("shoulder", "hip") if name != chosen)
    answer = ckc("run", "mine/own", "--set", f"initial.q.{other}=1.2")
    assert answer.code == 2
    assert answer.err.startswith(f"error: mine/own: initial.q: {chosen} missing; expected {chosen}, which were chosen")
    assert "because mine/mechanism.toml has no key independent; set independent = [...] there" in answer.err


def test_suggested_next_command_is_quoted(tmp_path: Path) -> None:
    (tmp_path / "my robots").mkdir()
    answer = ckc("new", str(tmp_path / "my robots" / "arm"))
    assert answer.out.splitlines()[-1] == f"next: cd '{tmp_path}/my robots/arm' && ckc run ."


def test_unwritable_new_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    answer = ckc("new", str(tmp_path / "file" / "mine"))
    assert answer.code == 2
    assert answer.err == f"error: {tmp_path / 'file' / 'mine'}: no folder that can be written to: Not a directory\n"


def test_folder_without_default_scene_lists_its_scenes(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mine)
    Path("default.scene.toml").rename("drop.scene.toml")
    assert ckc("run", ".", *SHORT_RUN).out.startswith("Run of mine/drop, done")
    for word in ("drop", "drop.scene.toml"):
        assert ckc("run", word, *SHORT_RUN).out.startswith(f"Run of {word}, done")
        assert ckc("check", word).code == 0
    monkeypatch.chdir(mine.parent)
    assert ckc("run", "mine/drop", *SHORT_RUN).code == 0
    other = mine / "other.scene.toml"
    other.write_text((mine / "drop.scene.toml").read_text(encoding="utf-8"), encoding="utf-8")
    both = ckc("run", "mine")
    assert both.code == 2
    assert "name one of its scenes: drop.scene.toml, other.scene.toml" in both.err
    other.unlink()
    (mine / "drop.scene.toml").unlink()
    none = ckc("run", "mine")
    assert none.code == 2
    assert "mine: it contains no scene, *.scene.toml; ckc new NAME makes a folder with an example" in none.err
    simulate("five_bar/swing", {"t_end": 0.01}).save(mine / "run.npz")
    assert "mine: a finished run, not a scene; ckc play, plot and inverse accept this folder" in ckc("run", "mine").err


# --- what is drawn, results that are saved ---------------------------------------------------------------------


def test_figures_option_draws_figures(tmp_path: Path) -> None:
    plain, drawn = tmp_path / "plain", tmp_path / "drawn"
    assert ckc("run", "five_bar/swing", *SHORT_RUN, "--out", str(plain)).code == 0
    assert sorted(path.name for path in plain.iterdir()) == ["run.npz", "scene.json"]
    assert ckc("run", "five_bar/swing", *SHORT_RUN, "--out", str(drawn), "--figures").code == 0
    names = {path.name for path in drawn.iterdir()}
    assert names == {"run.npz", "scene.json", "motion.png", "motion_snapshots.png"}
    forces = tmp_path / "forces"
    assert ckc("inverse", str(plain), "--out", str(forces)).code == 0
    assert [path.name for path in forces.iterdir()] == ["inverse.npz"]
    for command in (("run", "five_bar/swing"), ("inverse", "five_bar/tracking")):
        assert "--figures goes with --out DIR; give both" in ckc(*command, "--figures").err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "five_bar/swing", *SHORT_RUN), "not saved: --out DIR keeps the run, for ckc play, plot and inverse"),
        (("inverse", "five_bar/set_point", *SHORT_RUN), "not saved: --out DIR keeps inverse.npz, for other programs"),
        (("map", "four_bar", "--cells", "16"), "not drawn: --out DIR draws the map there"),
    ],
)
def test_commands_without_out_say_how_to_save(words: tuple[str, ...], says: str) -> None:
    answer = ckc(*words)
    assert answer.code == 0
    assert answer.out.splitlines()[-1] == says
    quiet = ckc(*words, "--json")
    assert quiet.json
    assert "--out" not in quiet.out + quiet.err


# --- warnings ----------------------------------------------------------------------------------------


def _warned(answer: Outcome) -> list[str]:
    return [line for line in (answer.out + answer.err).splitlines() if "warning" in line and "0 warnings" not in line]


def test_warnings_are_printed_once() -> None:
    about_limits = "joint limits are not stops"
    assert any(about_limits in warning for warning in check("talos").warnings)
    assert len(_warned(ckc("run", "talos", *SHORT_RUN))) == 1
    assert _warned(ckc("run", "five_bar_as_printed/tracking", *SHORT_RUN)) == [], "so short it stays inside"
    spoilt = ckc("run", "five_bar_as_printed/tracking", "--set", "formulation=reduced")
    assert len(_warned(spoilt)) == 1
    assert "leaves the workspace at t = 4.393" in spoilt.err
    assert "warning" not in ckc("check", "five_bar_as_printed/tracking", "--json").err


# --- help --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_placeholders_in_help_have_one_style(name: str) -> None:
    said = ckc(name, "--help").out
    shown = re.findall(r"^  (?:-h, )?(--\S+)(?: (\S+))?  ", said, re.MULTILINE)
    assert ("--help", "") in shown
    for option, value in shown:
        assert value not in {"TEXT", "INTEGER", "FLOAT", "PATH", "FOLDER", "DIRECTORY", "FILENAME"}, option
        assert re.fullmatch(r"|[A-Z]+(=[A-Z]+|,[A-Z])?|\[[a-z0-9.|]+\]", value), (option, value)
        if option in ("--out", "--meshes"):
            assert value == "DIR"


def test_invalid_choices_are_rejected_with_the_valid_ones() -> None:
    assert "'joint', 'cartesian'" in ckc("map", "five_bar", "--space", "outer").err
    assert "'mjcf'" in ckc("export", "five_bar", "--to", "obj").err


def test_spinner_appears_on_terminals_after_a_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    piped = Spinner("piped")
    with piped:
        assert piped.display is None
    monkeypatch.setattr(output, "is_terminal", lambda: True)
    quick = Spinner("quick")
    with quick:
        assert not quick.display.live.is_started
    assert not quick.display.live.is_started
    monkeypatch.setattr(output, "SPINNER_DELAY_S", 0.0)
    slow = Spinner("slow")
    with slow:
        slow.timer.join()
        assert slow.display.live.is_started
    assert not slow.display.live.is_started


@pytest.mark.parametrize(("share", "lines"), [(0.1, ["the run: about 27 s more"]), (0.5, [])])
def test_remaining_time_of_a_long_command_is_printed_once_in_a_pipe(
    share: float, lines: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tenth in three seconds makes 30 s in total, which is printed; half makes 6 s. Preparation is not counted."""
    clock = [100.0]
    monkeypatch.setattr(output, "perf_counter", lambda: clock[0])
    output.error_console.cache_clear()
    with ProgressBar("the run") as progress:
        for second, part in ((60.0, 0.0), (61.0, 0.01), (63.0, share), (64.0, share + 0.01), (65.0, share + 0.02)):
            clock[0] = 100.0 + second
            progress(2.0 * part, 2.0)
    assert capsys.readouterr().err.splitlines() == lines
    output.error_console.cache_clear()
