"""Help texts of commands, and how option values are parsed and printed."""

from __future__ import annotations

import math

import pytest

from ckc_pin.base.summary import to_json
from ckc_pin.cli.app import COMMANDS
from ckc_pin.cli.options import read_overrides
from tests.contract.helpers.command import ckc


def test_list_shows_all_mechanisms_and_scenes() -> None:
    listed = ckc("list", "--json").json["mechanisms"]
    scenes = {entry["name"]: entry["scenes"] for entry in listed}
    assert set(scenes["five_bar"]) >= {"default", "set_point", "swing", "tracking"}
    plain = ckc("list").out
    for entry in listed:
        assert entry["about"] in plain
        assert all(f"{entry['name']}/{scene}" in plain for scene in entry["scenes"])


def test_ckc_without_command_prints_an_introduction() -> None:
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


def test_settings_are_parsed_as_toml_or_text() -> None:
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


def test_later_settings_override_earlier_ones() -> None:
    words = ("run", "five_bar/swing", "--json", "--set", "t_end=9.0", "--set", "solver.output_dt=0.1")
    result = ckc(*words, "--set", "t_end=0.1", "--set", "solver.method=RK45").json
    assert result["t"] == 0.1
    assert result["stats"]["method"] == "RK45"


def test_nan_and_infinity_are_null_in_json() -> None:
    assert to_json({"a": math.nan, "b": [math.inf, 1.0], "c": {"d": (-math.inf,)}}) == (
        '{"a": null, "b": [null, 1.0], "c": {"d": [null]}}'
    )


def test_unprintable_names_are_escaped() -> None:
    assert ckc("check", "\udcff.toml", "--json").json["message"].endswith("no such mechanism file")


def test_short_help_is_not_truncated():
    listed = ckc("--help").out.split("Commands:")[1]
    assert "..." not in listed
    assert "(Fig" not in listed
