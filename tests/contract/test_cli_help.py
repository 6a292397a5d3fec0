"""What the commands say of themselves, and how values are read and printed."""

from __future__ import annotations

import math

import pytest

from ckc_pin.base.summary import to_json
from ckc_pin.cli.app import COMMANDS
from ckc_pin.cli.arguments import read_overrides
from tests.contract.helpers.command import ckc


def test_list() -> None:
    listed = ckc("list", "--json").json["mechanisms"]
    scenes = {entry["name"]: entry["scenes"] for entry in listed}
    assert set(scenes["five_bar"]) >= {"default", "set_point", "swing", "tracking"}
    plain = ckc("list").out
    for entry in listed:
        assert entry["about"] in plain
        assert all(f"{entry['name']}/{scene}" in plain for scene in entry["scenes"])


def test_ckc_alone_says_where_to_begin() -> None:
    answer = ckc()
    assert answer.code == 0
    for words in ("Begin with", "ckc list", "ckc run five_bar/tracking", "ckc play"):
        assert words in answer.out
    assert ckc("--help").out == ckc("-h").out == answer.out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_has_an_example(name: str) -> None:
    answer = ckc(name, "--help")
    assert answer.code == 0
    assert f"\n    ckc {name}" in answer.out.partition("Examples:")[2]


def test_values_of_settings() -> None:
    read = read_overrides(
        "--set",
        [
            "a=1",
            "b.c=1e-3",
            "d=spf",
            'e="quoted"',
            "f=true",
            "g=[[1.0, 2.0]]",
            "h={x = 1}",
            "i=",
            "k = 2 # two",
            "l==x",
        ],
    )
    assert read == {
        "a": 1,
        "b.c": 1e-3,
        "d": "spf",
        "e": "quoted",
        "f": True,
        "g": [[1.0, 2.0]],
        "h": {"x": 1},
        "i": "",
        "k": 2,
        "l": "=x",
    }


def test_later_settings_win_and_reach_into_tables() -> None:
    words = ("run", "five_bar/swing", "--json", "--set", "t_end=9.0", "--set", "solver.output_dt=0.1")
    found = ckc(*words, "--set", "t_end=0.1", "--set", "solver.method=RK45").json
    assert found["t"] == 0.1
    assert found["stats"]["method"] == "RK45"


def test_json_knows_no_nan_and_no_infinity() -> None:
    assert to_json({"a": math.nan, "b": [math.inf, 1.0], "c": {"d": (-math.inf,)}}) == (
        '{"a": null, "b": [null, 1.0], "c": {"d": [null]}}'
    )


def test_a_name_that_no_terminal_can_show_is_no_error() -> None:
    assert ckc("check", "\udcff.toml", "--json").json["message"].endswith("no such mechanism file")


def test_no_summary_of_a_command_is_cut_off():
    listed = ckc("--help").out.split("Commands:")[1]
    assert "..." not in listed
    assert "(Fig" not in listed
