"""`ckc check`: mass and inertia, properties of joints, and warnings about a model."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ckc_pin import InputError, check, load, load_scene
from ckc_pin.base.summary import to_json
from ckc_pin.formats.exporting import export
from ckc_pin.mechanism.library import shipped
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc

HANGING = {"theta_1": -1.434, "theta_2": 0.248, "theta_3": -1.707, "theta_4": -0.248}


def edit(path: Path, *edits: tuple[str, str]) -> None:
    text = path.read_text(encoding="utf-8")
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")


def add(bar: Path, tables: str) -> None:
    edit(bar / "mechanism.toml", ("[[point]]", f"{tables}\n[[point]]"))


def limit(bar: Path, joint: str, lower: float, upper: float) -> None:
    limits = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    edit(bar / "five_bar.urdf", (f'"{joint}" type="continuous">', f'"{joint}" type="revolute">{limits}'))


def warnings(what: str) -> list[str]:
    """Return the warnings, which are in the JSON only, with exit code 0."""
    answer = ckc("check", what, "--json")
    assert answer.code == 0
    messages: list[str] = answer.json["warnings"]
    assert answer.err == ""
    return messages


# --- overrides ----------------------------------------------------------------------------


def test_check_accepts_the_overrides_of_a_run() -> None:
    """For a scene its keys and the mechanism's parameters, for a mechanism its parameters."""
    overrides = {"controller.K_P": 2.0, "link.link_2.mass": 0.3}
    line = [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    of_command = ckc("check", "five_bar/set_point", *line, "--json").json
    of_python, of_scene = check("five_bar/set_point", overrides), check(load_scene("five_bar/set_point", overrides))
    assert of_command == json.loads(to_json(of_python.to_dict())) == json.loads(to_json(of_scene.to_dict()))
    assert of_python.stability is not None
    assert of_python.stability.least_eigenvalue != check("five_bar/set_point").stability.least_eigenvalue  # type: ignore[union-attr]
    lighter = {"link.link_2.mass": 0.0625}
    model = load("five_bar").tree.model
    mass = model.inertias[model.getJointId("theta_2")].mass
    assert check("five_bar", lighter).mass == pytest.approx(check("five_bar").mass - mass + 0.0625)


def test_overrides_without_a_name_are_refused() -> None:
    with pytest.raises(InputError, match="check: overrides: expected none with a Mechanism"):
        check(load("five_bar"), {"link.link_2.mass": 0.3})
    answer = ckc("check", "five_bar", "--set", "t_end=3")
    assert answer.code == 2
    assert "'t_end' names nothing; names begin with" in answer.err


# --- mass and inertia ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", shipped())
def test_mass_and_inertia_equal_mujocos(name: str) -> None:
    """Summed over MuJoCo's bodies in the key frame."""
    mechanism = load(name)
    result = check(mechanism)
    model = mujoco.MjModel.from_xml_string(export(mechanism, "mjcf").text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    mass = model.body_mass
    arms = data.xipos - mass @ data.xipos / mass.sum()
    turned = [
        R.reshape(3, 3) @ np.diag(I) @ R.reshape(3, 3).T for R, I in zip(data.ximat, model.body_inertia, strict=True)
    ]
    inertia = sum(I + m * ((r @ r) * np.eye(3) - np.outer(r, r)) for I, m, r in zip(turned, mass, arms, strict=True))
    assert_close(result.mass, mass.sum(), 1e-10 * mass.sum())
    assert_close(result.inertia, inertia, 1e-9, relative=True)


def test_mass_and_inertia_are_printed_and_in_the_json(bar: Path) -> None:
    data = ckc("check", "bar", "--json").json
    assert data["mass"] == pytest.approx(0.2451 + 2 * 0.2611 + 0.2352, rel=1e-14)
    assert np.shape(data["inertia"]) == (3, 3)
    printed = " ".join(ckc("check", "bar").out.split())
    assert "size, moving mass 0.3048 m, 1.0025 kg" in printed
    assert "its inertia, kg m² ixx" in printed
    assert f"izz = {data['inertia'][2][2]:.6g} as assembled, about its centre of mass" in printed


def test_mechanism_without_mass_has_zero_inertia(bar: Path) -> None:
    """A centre of mass does not exist then."""
    path = bar / "five_bar.urdf"
    before, *links = path.read_text(encoding="utf-8").split("<inertial>")
    path.write_text(before + "".join(link.partition("</inertial>")[2] for link in links), encoding="utf-8")
    data = ckc("check", "bar", "--json").json
    assert data["mass"] == 0.0
    assert data["inertia"] == np.zeros((3, 3)).tolist()


# --- joints ----------------------------------------------------------------------------------------


def test_joints_with_armature_friction_or_stops_are_listed(bar: Path) -> None:
    limit(bar, "theta_2", -2.0, 2.5)
    limit(bar, "theta_4", -2.5, 2.0)
    dynamics = '<dynamics damping="0.3" friction="0.25"/>'
    edit(bar / "five_bar.urdf", ('"theta_1" type="continuous">', f'"theta_1" type="continuous">{dynamics}'))
    add(
        bar,
        '[[joint]]\nname = "theta_1"\narmature = 0.5\n'
        '[[joint]]\nname = "theta_2"\nstops = true\nrestitution = 0.75\n'
        '[[joint]]\nname = "theta_3"\ndamping = 0.125\n',
    )
    nothing = {"armature": 0.0, "damping": 0.0, "friction": 0.0, "lower": None, "upper": None, "restitution": 0.0}
    assert ckc("check", "bar", "--json").json["joints"] == {
        "theta_1": nothing | {"armature": 0.5, "damping": 0.3, "friction": 0.25},
        "theta_2": nothing | {"lower": -2.0, "upper": 2.5, "restitution": 0.75},
    }
    printed = " ".join(ckc("check", "bar").out.split())
    assert "joint theta_1 armature 0.5 kg m² damping 0.3 N m s/rad friction 0.25 N m" in printed
    assert "joint theta_2 stops -2 to 2.5 rad restitution 0.75" in printed
    assert warnings("bar") == [
        "joint limits are not stops, so a run may pass them: theta_4; stops = true in their [[joint]] adds stops"
    ]


def test_plain_joints_are_not_listed(bar: Path) -> None:
    assert ckc("check", "bar", "--json").json["joints"] == {}
    assert "armature" not in ckc("check", "bar").out


# --- warnings --------------------------------------------------------------------------------------


def test_moving_links_without_mass_are_named(bar: Path) -> None:
    """One link has no <inertial>, one has mass 0. Frames on links with mass are not named."""
    text = (bar / "five_bar.urdf").read_text(encoding="utf-8")
    link_4 = text[text.index('<link name="link_4">') :].partition("<visual>")[0]
    edit(bar / "five_bar.urdf", ('<mass value="0.2451"/>', '<mass value="0"/>'), (link_4, '<link name="link_4">'))
    assert warnings("bar") == [
        "links that move without mass (no <inertial>, or its mass is 0): link_1, link_4",
    ]


def test_massless_crosses_of_universal_joints_are_not_named() -> None:
    """Delta's arms swing about two intersecting axes, with a link of no mass and no length between them."""
    mechanism = load("delta")
    assert any(body.mass == 0 for body in list(mechanism.tree.model.inertias)[1:])
    assert check(mechanism).warnings == ()


def test_springs_without_stiffness_and_damping_are_named(bar: Path) -> None:
    """A spring with damping only is not named."""
    add(bar, '[[spring]]\njoint = "theta_1"\ndamping = 1.0\n[[spring]]\njoint = "theta_2"\nrest = 0.1')
    assert warnings("bar") == ["spring 2 does nothing: it has neither stiffness nor damping"]


def test_springs_within_one_body_are_named(bar: Path) -> None:
    """Between links joined by a fixed joint, or a link and a frame on it; a spring between two bodies is not named."""
    add(
        bar,
        '[[spring]]\nframe_a = "link_2"\nframe_b = "tip_left"\nstiffness = 1.0\n'
        '[[spring]]\nframe_a = "world"\nframe_b = {link = "base", xyz = [0.0, 1.0, 0.0]}\ndamping = 1.0\n'
        '[[spring]]\nframe_a = "base"\nframe_b = "tip_left"\nstiffness = 1.0',
    )
    says = "does nothing: its frames belong to the same rigid body"
    assert warnings("bar") == [f"spring 1 {says}", f"spring 2 {says}"]


@pytest.mark.parametrize(("off", "is_far"), [(0.45, False), (-0.45, False), (0.55, True), (-0.55, True)])
def test_assembly_far_from_the_guess_is_named(off: float, is_far: bool, bar: Path) -> None:
    """By more than half a radian, for coordinates that the guess names."""
    shifted = HANGING["theta_4"] - off
    edit(bar / "mechanism.toml", ("theta_2 = 0.248\n", ""), ("theta_4 = -0.248", f"theta_4 = {shifted!r}"))
    at = ckc("check", "bar", "--json").json["q_tree"][3]
    distance = f"theta_4 = {at:.4g} (guess {shifted:.4g})"
    warning = f"assembled more than 0.5 rad, or 0.5 of the size 0.305 m, from q_guess: {distance}"
    assert at == pytest.approx(HANGING["theta_4"], abs=1e-3)
    assert warnings("bar") == ([warning] if is_far else [])


def test_distance_of_a_slide_from_the_guess_is_relative_to_the_size(tmp_path: Path) -> None:
    """A block 0.4 m or 0.6 m along its slide, in a mechanism with a size of 1 m and a guess of 0."""
    (tmp_path / "s.urdf").write_text(
        '<robot name="s"><link name="base"/><link name="block"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="along" type="prismatic"><parent link="base"/>'
        '<child link="block"/><origin xyz="0 1 0"/><axis xyz="1 0 0"/></joint></robot>',
        encoding="utf-8",
    )
    for reach, far in ((0.4, []), (0.6, ["along = 0.6 (guess 0)"])):
        (tmp_path / "mechanism.toml").write_text(
            'name = "s"\nurdf = "s.urdf"\nq_guess = {along = 0.0}\n[[loop]]\nname = "held"\ntype = "point"\n'
            f'frame_a = "block"\nframe_b = {{link = "world", xyz = [{reach}, 1.0, 0.0]}}\n',
            encoding="utf-8",
        )
        texts = check(tmp_path / "mechanism.toml").warnings
        assert [text.partition("from q_guess: ")[2] for text in texts if "from q_guess: " in text] == far


def test_start_outside_joint_limits_is_named(bar: Path) -> None:
    """The assembled configuration of a mechanism, or the start of a scene."""
    limit(bar, "theta_1", -1.5, -1.2)
    add(bar, '[[joint]]\nname = "theta_1"\nstops = true')
    assert warnings("bar") == []
    assert warnings("bar/swing.scene.toml") == [
        "bar/swing.scene.toml: initial: theta_1 = -0.934309 is beyond its stops, -1.5 to -1.2; give another initial.q, "
        "or a q_guess within the stops"
    ]
    edit(bar / "five_bar.urdf", ('lower="-1.5" upper="-1.2"', 'lower="-1" upper="-0.5"'))
    edit(bar / "mechanism.toml", ("stops = true", "stops = false"))  # limits without stops do not restrict assembly
    assert "the start is outside" not in "".join(warnings("bar/swing.scene.toml"))
    assert "the assembled configuration is outside joint limits: theta_1 = -1.434 (limits -1 to -0.5)" in warnings(
        "bar"
    )


def test_assembly_moved_by_stops_is_named(bar: Path) -> None:
    limit(bar, "theta_1", -1.0, -0.5)
    add(bar, '[[joint]]\nname = "theta_1"\nstops = true')
    messages = warnings("bar")
    assert messages[0].startswith("q_guess leads beyond stops of joints; assembled within the stops: theta_1 = -0.99")


def test_configuration_at_a_limit_is_inside(bar: Path) -> None:
    """Up to rounding errors."""
    limit(bar, "theta_1", -1.434 + 1e-12, 0.0)
    add(bar, '[[joint]]\nname = "theta_1"\nstops = true')
    assert warnings("bar") == []


def test_scene_without_a_start_is_a_warning(bar: Path) -> None:
    """`ckc run` refuses it, but `ckc check` prints the mechanism's properties."""
    limit(bar, "theta_2", -3.0, 3.0)
    add(bar, '[[joint]]\nname = "theta_2"\nstops = true')
    edit(bar / "swing.scene.toml", ("theta_1 = -0.934308508090164", "theta_1 = 3.0"))
    (said,) = warnings("bar/swing.scene.toml")
    assert said.startswith("bar/swing.scene.toml: initial: the start theta_1 = 3, theta_3 = -1.20733 is out of reach")
