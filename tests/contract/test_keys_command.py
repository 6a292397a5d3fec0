"""`ckc keys`, `--unset` and `ckc play --video`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ckc_pin import InputError, load_scene
from ckc_pin.cli.app import COMMANDS
from ckc_pin.cli.key_tables import FILES, find_tables, tables
from tests.contract.helpers.command import ckc

# --- keys ------------------------------------------------------------------------------------------


def test_keys_of_all_files_are_printed_with_type_default_unit_and_meaning() -> None:
    answer = ckc("keys")
    assert answer.code == 0
    lines = answer.out.splitlines()
    for file in FILES:
        for table in tables(file):
            assert any(line.startswith(f"{table.heading}") for line in lines)
            for key in table.keys:
                assert any(line.split()[:1] == [key.name] and key.kind in line and key.unit in line for line in lines)


def test_keys_of_one_table_are_a_line_each() -> None:
    lines = ckc("keys", "motor").out.splitlines()
    assert lines[0].startswith("[[motor]] in mechanism.toml: A motor on a joint")
    (ratio,) = [line for line in lines if line.startswith("  ratio ")]
    assert ratio.split(maxsplit=1)[1] == (
        "number, unit of the motor per unit of the joint; default 1.0. Gear ratio, with its sign; not 0."
    )
    assert len(lines) == 1 + 7


@pytest.mark.parametrize(
    ("name", "headings"),
    [
        ("solver", ["[solver]"]),
        ("scene.solver", ["[solver]"]),
        ("tracking", ['[controller] with type = "tracking"']),
        ("controller.set_point", ['[controller] with type = "set_point"']),
        ("circle", ["[controller.desired.circle]"]),
        ("force", ["[[force]]", "[[force]]"]),
        ("motor", ["[[motor]]"]),
        ("controller.motor", ["[controller.motor.NAME]"]),
    ],
)
def test_table_is_found_by_path_last_part_or_type(name: str, headings: list[str]) -> None:
    assert [table.heading for _, table in find_tables(name)] == headings


def test_file_stands_for_all_its_tables() -> None:
    assert [table for _, table in find_tables("mechanism")] == list(tables("mechanism"))


@pytest.mark.parametrize(("name", "nearest"), [("motr", "motor"), ("trackin", "tracking"), ("Solver", "solver")])
def test_unknown_table_names_the_nearest(name: str, nearest: str) -> None:
    answer = ckc("keys", name)
    assert answer.code == 2
    assert f"no table {name!r}; there are mechanism, scene, sweep, identify, calibrate, optimize, " in " ".join(
        answer.err.split()
    )
    assert f"did you mean {nearest!r}?" in " ".join(answer.err.split())


def test_keys_as_json_have_examples() -> None:
    (table,) = ckc("keys", "solver", "--json").json["tables"]
    assert (table["file"], table["table"], table["heading"]) == ("scene", "solver", "[solver]")
    rtol = next(key for key in table["keys"] if key["name"] == "rtol")
    assert (rtol["default"], rtol["example"]) == ("1e-08", "rtol = 1e-10")


def test_keys_need_no_optional_package() -> None:
    heavy = "scipy", "matplotlib", "casadi", "mujoco", "dask", "xarray", "zarr", "meshcat", "yourdfpy"
    code = f"import sys, ckc_pin.cli.key_tables; print([x for x in {heavy} if x in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


# --- unset -----------------------------------------------------------------------------------------


def test_unset_removes_a_key_of_the_scene() -> None:
    """As None does in Python: without its table of events or its controller, a scene runs without them."""
    assert "controller" not in load_scene("five_bar/set_point", {"controller": None}).to_dict()
    with_controller = ckc("run", "five_bar/set_point", "--set", "t_end=0.1", "--json").json
    without = ckc("run", "five_bar/set_point", "--set", "t_end=0.1", "--unset", "controller", "--json").json
    assert with_controller["max_abs_u"] > 0.1
    assert without["max_abs_u"] == 0.0


def test_unset_of_a_default_changes_nothing() -> None:
    answer = ckc("check", "five_bar/set_point", "--unset", "controller.torque_limit", "--unset", "solver", "--json")
    assert answer.code == 0
    assert answer.json == ckc("check", "five_bar/set_point", "--unset", "solver", "--json").json


def test_every_command_with_set_has_unset() -> None:
    for name in COMMANDS:
        text = ckc(name, "--help").out
        assert ("--set KEY=VALUE" in text) == ("--unset KEY" in text), name


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--unset", "contrller"], "contrller: a scene has no such key to remove: unknown key 'contrller'"),
        (["--unset", "controller.KP"], "did you mean 'K_P'?"),
        (["--unset", "controller.q_d.theta_7"], "controller.q_d has theta_1, theta_3; did you mean 'theta_1'?"),
        (["--unset", "link.link_2.mass"], "no such entry to remove; parameters has nothing"),
        (["--unset", "t_end"], "the key 't_end' is missing"),
        (["--unset", "t_end", "--set", "t_end=2"], "--unset t_end: --set gives it a value; leave one of them out"),
        (["--unset", "t_end=3"], "--unset t_end=3: write KEY, e.g. controller.torque_limit"),
    ],
)
def test_wrong_unset_is_refused(words: list[str], says: str) -> None:
    answer = ckc("check", "five_bar/set_point", *words)
    assert answer.code == 2
    assert says in " ".join(answer.err.split())


def test_parameters_of_a_mechanism_cannot_be_removed() -> None:
    answer = ckc("check", "five_bar", "--unset", "link.link_2.mass")
    assert answer.code == 2
    assert "only keys of a scene can be removed" in answer.err


def test_removing_an_entry_that_is_not_there_is_an_error_in_python() -> None:
    with pytest.raises(InputError, match=r"initial\.q has theta_1, theta_3"):
        load_scene("five_bar/swing", {"initial.q.theta_9": None})


# --- video -----------------------------------------------------------------------------------------


def test_video_of_another_ending_names_gif(tmp_path: Path) -> None:
    ckc("run", "five_bar/swing", "--set", "t_end=0.1", "--out", str(tmp_path))
    answer = ckc("play", str(tmp_path), "--video", str(tmp_path / "film.mp4"))
    assert answer.code == 2
    text = " ".join(answer.err.split())
    assert "film.mp4: expected a name that ends in .gif, the only format that is written" in text
    assert "ffmpeg -i film.gif film.mp4 converts it" in text
    assert not (tmp_path / "film.mp4").exists()
    assert ckc("play", str(tmp_path), "--video", str(tmp_path / "film.GIF")).code == 0
    assert (tmp_path / "film.GIF").read_bytes().startswith(b"GIF8")
