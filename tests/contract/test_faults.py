"""Faults of a file as data: path, value, and expected values or type."""

from __future__ import annotations

import random
import tomllib
from typing import Any, get_args

import msgspec
import pytest

from ckc_pin import InputError
from ckc_pin.base.toml import convert, find_faults
from ckc_pin.formats.urdf.robot_yaml import RobotYaml
from ckc_pin.mechanism.library import library
from ckc_pin.mechanism.spec import FrameSpec, LoopType, MechanismSpec
from ckc_pin.scene.spec import SceneSpec
from tests.contract.test_mutations import mutated


def shipped(file: str) -> Any:
    return tomllib.loads((library() / file).read_text(encoding="utf-8"))


def test_all_errors_of_a_file_are_found() -> None:
    data = shipped("five_bar/tracking.scene.toml")
    data |= {"t_end": -1, "formulation": "ode", "event": [{"of": "v"}, {"coordinat": "theta_1"}]}
    data["controller"] |= {"K_D": [[1.0, "a"], [0.0, 1.0]], "sample_time": True}
    del data["mechanism"]
    faults = {(fault.path, fault.kind): fault for fault in find_faults(data, SceneSpec)}
    assert set(faults) == {
        (("t_end",), "value"),
        (("formulation",), "value"),
        ((), "missing key"),
        (("event", 0, "of"), "value"),
        (("event", 1), "unknown key"),
        (("controller", "K_D", 0, 1), "value"),
        (("controller", "sample_time"), "value"),
    }
    assert faults[("formulation",), "value"].choices == ("dae", "reduced", "spf")
    assert faults[("event", 1), "unknown key"].choices == ("coordinate", "of", "value", "direction", "stop", "name")
    assert faults[("event", 1), "unknown key"].suggestion == "coordinate"
    assert faults[(), "missing key"].value == "mechanism"
    assert faults[("controller", "K_D", 0, 1), "value"].value == "a"


def test_one_message_names_all_places_and_counts_what_it_leaves_out() -> None:
    data = {"name": "", "gravity": 3, "tree": [{"root": "loose"}], "loop": [{"type": "x"}], "urdf": float("nan")}
    with pytest.raises(InputError) as refused:
        convert(data, MechanismSpec, "m.toml")
    message = str(refused.value)
    assert message.startswith("m.toml: (1) name = ''")
    for place in ("(2) urdf", "(3) tree[0]", "'file'", "(4) tree[0].root", "'fixed'", "(5) gravity = 3"):
        assert place in message
    assert message.endswith(" and 4 more")  # of the loop: its type, name, frame_a and frame_b


def test_a_misspelled_key_is_not_also_missing() -> None:
    (fault,) = find_faults({"lnk": "tip"}, FrameSpec)
    assert (fault.kind, fault.value, fault.suggestion) == ("unknown key", "lnk", "link")


def test_choices_are_those_of_the_type() -> None:
    (fault,) = find_faults("hing", LoopType)
    assert fault.choices == tuple(sorted(get_args(LoopType)))


def test_list_entries_with_the_same_error_are_reported_once() -> None:
    faults = [fault.path for fault in find_faults({"gravity": ["a", "b", "c"], "name": "x"}, MechanismSpec)]
    assert faults == [("gravity", 0)]


def test_keys_that_are_not_strings_are_rejected() -> None:
    with pytest.raises(InputError, match=r"robot.yaml: .*str"):
        convert({1: "a"}, RobotYaml, "robot.yaml")


@pytest.mark.parametrize(
    ("kind", "file"),
    [(SceneSpec, "five_bar/tracking.scene.toml"), (SceneSpec, "delta/circle.scene.toml"),
     (MechanismSpec, "five_bar/mechanism.toml"), (MechanismSpec, "two_ur5/mechanism.toml"),
     (MechanismSpec, "flyball/mechanism.toml")],
)  # fmt: skip
def test_faults_agree_with_msgspec(kind: Any, file: str) -> None:
    r, data_file, refused = random.Random(5), shipped(file), 0
    if "q_guess" in data_file:
        data_file["q_guess"] = {
            key: value for key, value in data_file["q_guess"].items() if not isinstance(value, dict)
        }
    for _ in range(400):
        data = mutated(r, mutated(r, data_file))
        try:
            msgspec.convert(data, kind)
            fits = True
        except msgspec.ValidationError:
            fits = False
        faults = [*find_faults(data, kind)]
        assert fits == (not faults), data
        refused += not fits
        for fault in faults:
            assert _at(data, fault.path) is fault.value or fault.kind != "value"
            assert fault.expected or fault.choices or fault.kind == "missing key"
    assert 50 < refused < 400


def _at(data: Any, steps: tuple[Any, ...]) -> Any:
    for step in steps:
        data = data[step]
    return data
