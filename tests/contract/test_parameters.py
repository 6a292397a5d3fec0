"""Parameters of a mechanism by name: effect, rejected values, and recording in runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.library import library
from tests.contract.helpers.command import ckc

SPRUNG = """
name = "sprung"
urdf = "two.urdf"
gravity = [0, -9.81, 0]
independent = ["elbow"]
[q_guess]
elbow = 0.3
hip = 0.1
[[loop]]
name = "knee"
type = "distance"
frame_a = {link = "rod", xyz = [0.3, 0, 0]}
frame_b = {link = "world", xyz = [0.7, 0.1, 0]}
length = 0.5
[[spring]]
frame_a = "rod"
frame_b = {link = "world", xyz = [0.2, 0.3, 0]}
stiffness = 40.0
rest_length = 0.1
[[spring]]
joint = "hip"
rest = 0.2
stiffness = 3.0
damping = 0.1
[[force]]
joint = "elbow"
value = 0.2
"""
URDF = """<robot name="two"><link name="base"/>
<link name="arm"><inertial><origin xyz="0.2 0.01 0"/><mass value="1.5"/>
<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
<link name="rod"><inertial><origin xyz="0.1 0 0" rpy="0 0 0.4"/><mass value="0.8"/>
<inertia ixx="0.004" iyy="0.006" izz="0.008" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="continuous"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
<axis xyz="0 0 1"/></joint>
<joint name="elbow" type="continuous"><parent link="arm"/><child link="rod"/><origin xyz="0.4 0 0" rpy="0 0 0.3"/>
<axis xyz="0 0 1"/></joint></robot>"""

# name, value, what is in the files, what is there in its place
EDITS = [
    ("link.arm.mass", 3.0, URDF, 'mass value="1.5"/>\n<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0.001"',
     'mass value="3"/>\n<inertia ixx="0.02" iyy="0.04" izz="0.05" ixy="0.002"'),
    ("link.arm.com", (0.1, 0.05, 0.0), URDF, "0.2 0.01 0", "0.1 0.05 0"),
    ("link.rod.com.y", 0.03, URDF, "0.1 0 0", "0.1 0.03 0"),
    ("link.rod.inertia.izz", 0.009, URDF, 'izz="0.008"', 'izz="0.009"'),
    ("joint.elbow.xyz", (0.35, 0.01, 0.0), URDF, "0.4 0 0", "0.35 0.01 0"),
    ("joint.elbow.rpy.z", 0.2, URDF, "0 0 0.3", "0 0 0.2"),
    ("loop.knee.frame_a.xyz.x", 0.32, SPRUNG, "[0.3, 0, 0]", "[0.32, 0, 0]"),
    ("loop.knee.length", 0.52, SPRUNG, "length = 0.5", "length = 0.52"),
    ("spring.0.stiffness", 50.0, SPRUNG, "stiffness = 40.0", "stiffness = 50.0"),
    ("spring.0.frame_a.xyz", (0.1, 0.0, 0.0), SPRUNG, 'frame_a = "rod"', 'frame_a = {link = "rod", xyz = [0.1, 0, 0]}'),
    ("spring.1.rest", 0.4, SPRUNG, "rest = 0.2", "rest = 0.4"),
    ("force.0.value", -0.3, SPRUNG, "value = 0.2", "value = -0.3"),
    ("gravity.y", -1.62, SPRUNG, "-9.81", "-1.62"),
    ("joint.hip.damping", 0.3, SPRUNG, "", '[[joint]]\nname = "hip"\ndamping = 0.3'),
]  # fmt: skip


def folder(at: Path, toml: str = SPRUNG, urdf: str = URDF) -> Path:
    at.mkdir()
    (at / "mechanism.toml").write_text(toml)
    (at / "two.urdf").write_text(urdf)
    (at / "default.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.1\n[initial]\nat = "assembled"\n'
    )
    return at


@pytest.mark.parametrize(("name", "value", "text", "old", "new"), EDITS, ids=[edit[0] for edit in EDITS])
def test_parameter_override_equals_an_edited_file(
    tmp_path: Path, name: str, value: object, text: str, old: str, new: str
) -> None:
    plain = folder(tmp_path / "plain")
    assert text.count(old) == 1 or not old
    edited = text.replace(old, new) if old else f"{text}\n{new}\n"
    other = folder(tmp_path / "edited", *((SPRUNG, edited) if text is URDF else (edited, URDF)))
    state = {"elbow": 0.3}, {"elbow": -1.2}
    by_name = ckc_pin.terms(ckc_pin.load(plain / "mechanism.toml", {name: value}), *state)
    by_file = ckc_pin.terms(ckc_pin.load(other / "mechanism.toml"), *state)
    for term in ("rho", "D", "C", "h"):
        assert np.array_equal(getattr(by_name, term), getattr(by_file, term)), term
    run, same = (ckc_pin.simulate(at, c) for at, c in ((plain, {name: value}), (other, None)))
    assert np.array_equal(run.q_tree, same.q_tree)
    assert not np.array_equal(run.q_tree, ckc_pin.simulate(plain).q_tree)


def test_run_records_its_parameters(tmp_path: Path) -> None:
    done = ckc("run", "five_bar/swing", "--set", "joint.theta_2.xyz.x=0.28", "--set", "link.link_2.mass=0.4",
               "--set", "t_end=0.05", "--json", "--out", str(tmp_path))  # fmt: skip
    assert done.code == 0
    run = ckc_pin.Run.load(tmp_path)
    assert run.scene["parameters"] == {"joint.theta_2.xyz.x": 0.28, "link.link_2.mass": 0.4}
    assert run.mechanism.spec.gravity == (0.0, -9.81, 0.0)
    assert run.points["tip"][-1].tolist() == done.json["points"]["tip"]


def test_scene_has_a_table_of_parameters(tmp_path: Path) -> None:
    at = folder(tmp_path / "own")
    with (at / "default.scene.toml").open("a") as scene:
        scene.write("[parameters]\nlink.arm.mass = 2.0\n'gravity.y' = -5\n")
    run = ckc_pin.simulate(at)
    assert run.scene["parameters"] == {"link.arm.mass": 2.0, "gravity.y": -5.0}
    assert np.array_equal(run.q_tree, ckc_pin.simulate(at, {"link.arm.mass": 2.0, "gravity.y": -5.0}).q_tree)


REFUSED = [
    ({"link.link_2.mas": 1.0}, "no 'link.link_2.mas'; there are link.link_2.mass, link.link_2.com,"),
    ({"link.link_9.mass": 1.0}, "there are link.link_1, link.link_2, link.link_3, link.link_4"),
    ({"spring.0.stiffness": 1.0}, "nothing of this mechanism is a spring"),
    ({"parameters.lnk.a.mass": 1.0}, "names begin with gravity, link, joint"),
    ({"gravity": 1.0}, "gravity takes three numbers"),
    ({"gravity.x": [1.0, 2.0, 3.0]}, "gravity.x takes one number"),
    ({"gravity.x": 1.0, "gravity": [0, 0, 0]}, "gravity and gravity.x are both given"),
    ({"link.link_2.mass": -1.0}, "link 'link_2': negative mass -1 kg"),
    ({"link.link_2.mass": float("nan")}, "parameters.link.link_2.mass = nan"),
    ({"link.link_2.inertia.izz": -1.0}, "negative principal moment"),
    ({"link.link_2.mass": "heavy"}, "expected a number or a list"),
    ({"joint.theta_2.xyz.x": 9.0}, "not closed"),
]  # fmt: skip


@pytest.mark.parametrize(("overrides", "says"), REFUSED, ids=[str(overrides) for overrides, _ in REFUSED])
def test_invalid_parameter_is_rejected_by_name(overrides: dict[str, object], says: str) -> None:
    with pytest.raises(CkcError, match=r"parameters|not closed") as error:
        ckc_pin.simulate("five_bar/swing", overrides)
    assert says in str(error.value)


def test_parameters_of_shipped_mechanisms_accept_their_values() -> None:
    from ckc_pin.mechanism.parameters import values_of

    for name in sorted(path.name for path in library().iterdir() if (path / "mechanism.toml").exists()):
        if name in ("talos", "two_ur5", "n_four_bar"):  # their trees come from elsewhere
            continue
        mechanism = ckc_pin.load(name)
        values = values_of(mechanism.spec, mechanism.urdf)
        assert len(values) > 5
        same = ckc_pin.load(name, values)
        assert same.tree.model == mechanism.tree.model
        assert np.array_equal(same.q_tree, mechanism.q_tree)
