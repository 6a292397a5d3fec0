"""`ckc import` of URDFs: loops inside the file, in a robot.yaml, or as pairs of frames; mimic joints."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from ckc_pin import load
from ckc_pin.formats.conversion import from_rpy, to_rpy
from ckc_pin.formats.importing import Draft, mechanism_text, read
from tests.conftest import assert_close

BODY = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'


def link(name: str, body: str = BODY) -> str:
    return f'<link name="{name}">{body}</link>'


def joint(name: str, parent: str, child: str, xyz: str = "0 0 0", axis: str = "0 0 1", **more: str) -> str:
    kind, rpy, inner = more.get("type", "revolute"), more.get("rpy", "0 0 0"), more.get("inner", "")
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
    return f'<joint name="{name}" type="{kind}" {more.get("attributes", "")}>{ends}<axis xyz="{axis}"/>{inner}</joint>'


def frame(name: str, parent: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    """A frame as onshape-to-robot writes it: a link on a fixed joint."""
    light = '<inertial><mass value="1e-9"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
    return link(name, light) + joint(f"{name}_frame", parent, name, xyz, rpy=rpy, type="fixed")


def imported(tmp_path: Path, content: str, yaml: str | None = None) -> Draft:
    path = tmp_path / "thing.urdf"
    path.write_text(f'<robot name="thing">{content}</robot>', encoding="utf-8")
    if yaml is not None:
        (tmp_path / "robot.yaml").write_text(yaml, encoding="utf-8")
    return read(path)


def has_note(notes: list[str], *fragments: str) -> bool:
    return any(all(fragment in note for fragment in fragments) for note in notes)


FOUR_BAR = (
    link("base")
    + link("crank")
    + link("coupler")
    + link("rocker")
    + joint("a", "base", "crank", attributes='independent="True"')
    + joint("b", "crank", "coupler", "1 0.5 0", attributes='independent="FALSE"')
    + joint("c", "base", "rocker", "2 0 0", rpy="0 0 1.5707963267948966", attributes='independent="false"')
)
PIN = """<loop name="pin" type="{type}"><predecessor link="coupler"><origin xyz="1 0.5 0"/></predecessor>
<successor link="rocker"><origin xyz="1 0 0" rpy="0 0 -1.5707963267948966"/></successor>{axis}</loop>"""


# --- generalized_rbda -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "ours", "rows", "rank"),
    [
        ("revolute", "hinge", 5, 2),
        ("continuous", "hinge", 5, 2),
        ("spherical", "point", 3, 2),
        ("fixed", "weld", 6, 3),
    ],
)
def test_loops_of_generalized_rbda_are_imported(tmp_path: Path, kind: str, ours: str, rows: int, rank: int) -> None:
    pin = PIN.format(type=kind, axis='<axis xyz="0 0 2"/>')
    draft = imported(tmp_path, FOUR_BAR + pin)
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type) == ("pin", ours)
    if ours == "hinge":
        assert loop.axis_a == loop.axis_b == (0.0, 0.0, 1.0)
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.closure.rows, mechanism.rank, mechanism.d) == (3, rows, rank, 3 - rank)
    assert "loop" not in draft.urdf_text()
    assert "independent" not in draft.urdf_text()


def test_independent_is_read_in_any_case_and_true_by_default(tmp_path: Path) -> None:
    draft = imported(tmp_path, FOUR_BAR + PIN.format(type="revolute", axis='<axis xyz="0 0 1"/>'))
    assert draft.independent == ["a"]
    assert draft.build_mechanism().independent == ("a",)
    chain = link("base") + link("x") + link("y") + joint("p", "base", "x", attributes='independent="true"')
    assert imported(tmp_path, chain + joint("q", "x", "y")).independent == ["p", "q"]


def test_independent_that_does_not_work_is_replaced_with_a_note(tmp_path: Path) -> None:
    wrong = FOUR_BAR.replace('independent="FALSE"', 'independent="true"')
    draft = imported(tmp_path, wrong + PIN.format(type="revolute", axis='<axis xyz="0 0 1"/>'))
    assert draft.independent is None
    assert has_note(draft.guessed, "independent is chosen by the program", "2 coordinates (a, b)", "d = 1")


@pytest.mark.parametrize(("axis", "along"), [('<axis xyz="0 3 0"/>', (0.0, 1.0, 0.0)), ("", (1.0, 0.0, 0.0))])
def test_prismatic_loop_has_the_declared_axis(tmp_path: Path, axis: str, along: tuple[float, ...]) -> None:
    draft = imported(tmp_path, FOUR_BAR + PIN.format(type="prismatic", axis=axis))
    ((loop, _),) = draft.loops
    assert (loop.type, loop.axis_a) == ("prismatic", along)


def test_couplings_of_generalized_rbda_are_imported(tmp_path: Path) -> None:
    content = "".join(link(name) for name in ("base", "thigh", "rotor", "shank", "motor"))
    content += joint("hip", "base", "thigh") + joint("spin", "base", "rotor")
    content += joint("knee", "thigh", "shank") + joint("drive", "base", "motor")
    content += '<coupling name="gear"><predecessor link="thigh"/><successor link="rotor"/><ratio value="6"/></coupling>'
    content += '<coupling name="belt"><predecessor link="shank"/><successor link="motor"/><ratio value="2"/></coupling>'
    draft = imported(tmp_path, content)
    gear, belt = (coupling for coupling, _ in draft.couplings)
    assert (gear.joint, gear.other, gear.ratio, gear.offset) == ("spin", "hip", 6.0, 0.0)
    assert (belt.name, belt.joints, belt.offset) == ("belt", {"drive": 1.0, "knee": -2.0, "hip": -2.0}, 0.0)
    assert draft.build_mechanism().d == 2


def test_rotors_behind_gears_are_those_of_drake(tmp_path: Path) -> None:
    """Files for ROS and Drake have both reductions, of which Drake reads its own."""
    content = (
        "".join(link(name) for name in ("base", "arm", "hand")) + joint("a", "base", "arm") + joint("b", "arm", "hand")
    )
    for name, gear, rotor in (("a", 100.0, 6e-5), ("b", -7.0, 2e-4)):
        content += f"""<transmission name="t{name}"><type>transmission_interface/SimpleTransmission</type>
        <joint name="{name}"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
        <actuator name="m{name}"><mechanicalReduction>1</mechanicalReduction><drake:gear_ratio value="{gear}"/>
        <drake:rotor_inertia value="{rotor}"/></actuator></transmission>"""
    mechanism = imported(tmp_path, content).build_mechanism()
    plant = MultibodyPlant(0.0)
    text = next(tmp_path.glob("*.urdf")).read_text()
    Parser(plant).AddModelsFromString(text.replace("<robot", '<robot xmlns:drake="http://drake.mit.edu"', 1), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    theirs = plant.CalcMassMatrix(plant.CreateDefaultContext())
    D = pin.crba(mechanism.tree.model, mechanism.tree.data, mechanism.tree.neutral())
    assert_close(np.triu(D), np.triu(theirs), 1e-12)


def test_link_without_inertia_is_a_point_mass_as_in_drake(tmp_path: Path) -> None:
    point = '<inertial><origin xyz="0.3 0.1 0"/><mass value="2"/></inertial>'
    draft = imported(tmp_path, link("base") + link("arm", point) + joint("a", "base", "arm"))
    assert has_note(draft.guessed, "links without <inertia> are point masses, as in Drake: arm")
    mechanism, plant = draft.build_mechanism(), MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString((tmp_path / "thing.urdf").read_text(), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    D = pin.crba(mechanism.tree.model, mechanism.tree.data, mechanism.tree.neutral())
    assert_close(D, plant.CalcMassMatrix(plant.CreateDefaultContext()), 1e-15)


def test_trees_beside_the_world_are_free(tmp_path: Path) -> None:
    content = "".join(link(name) for name in ("world", "arm", "body", "leg"))
    draft = imported(tmp_path, content + joint("turn", "world", "arm") + joint("hip", "body", "leg"))
    assert has_note(draft.guessed, "body is free", "root.x to root.rz")
    assert draft.build_mechanism().d == 8


# --- pairs of frames ------------------------------------------------------------------------------------------------

TILT = "0.3 -0.5 0.8"


def two_legs(
    offset: float = 0.0, base: str = "fixed", names: tuple[str, str] = ("closing_tip_1", "closing_tip_2")
) -> str:
    """Two legs of two hinges each in a tilted plane, meeting at frames that stand 90 degrees apart."""
    content = link("base") + link("plane") + joint("tilt", "base", "plane", "0 0.1 0.2", "1 0 0", rpy=TILT, type=base)
    for side, x in (("left", -0.5), ("right", 0.5)):
        content += link(f"{side}_upper") + joint(f"{side}_hip", "plane", f"{side}_upper", f"{x} 0 0")
        content += link(f"{side}_lower") + joint(f"{side}_knee", f"{side}_upper", f"{side}_lower", f"{x} 1 0")
    content += frame(names[0], "left_lower", "1 1 0", "1.5707963267948966 0 0")
    return content + frame(names[1], "right_lower", f"-1 1 {offset}", "0 0 0.7")


def test_planar_loop_is_point_2d(tmp_path: Path) -> None:
    draft = imported(tmp_path, two_legs())
    ((loop, comment),) = draft.loops
    assert (loop.name, loop.type) == ("tip", "point_2d")
    assert_close(loop.axis_a, [0.0, 1.0, 0.0], 1e-12)  # the plane's normal in the axes of the tilted frame
    assert comment.startswith("guessed: its joints move in one plane")
    assert has_note(draft.guessed, "point_2d for loop tip")
    mechanism = draft.build_mechanism()
    assert (mechanism.closure.rows, mechanism.rank, mechanism.d) == (2, 2, 2)


def test_planar_loop_on_a_turning_base_is_point_2d(tmp_path: Path) -> None:
    draft = imported(tmp_path, two_legs(base="revolute"))
    ((loop, _),) = draft.loops
    assert loop.type == "point_2d"
    assert_close(loop.axis_a, [0.0, 1.0, 0.0], 1e-12)
    assert draft.build_mechanism().d == 3


def test_offset_across_the_plane_is_noted(tmp_path: Path) -> None:
    draft = imported(tmp_path, two_legs(offset=0.03))
    assert has_note(draft.guessed, "point_2d for loop tip", "stay 30 mm apart")
    assert draft.build_mechanism().rank == 2


def test_pairs_without_the_prefix_must_be_only_frames(tmp_path: Path) -> None:
    pair = ("tip_1", "tip_2")
    assert [loop.name for loop, _ in imported(tmp_path, two_legs(names=pair)).loops] == ["tip"]
    third = two_legs(names=pair) + frame("tip_3", "base")
    assert not imported(tmp_path, third).loops
    heavy = two_legs(names=pair).replace('<mass value="1e-9"/>', '<mass value="0.2"/>')
    assert not imported(tmp_path, heavy).loops


def spatial(rpy: str) -> str:
    """Return a spatial loop. The frames coincide at the neutral configuration, their z axes rotated by rpy."""
    content = link("base") + link("in") + link("rod") + link("out")
    content += joint("drive", "base", "in") + joint("swing", "in", "rod", "0.4 0 0", axis="0 1 0")
    content += (
        joint("twist", "rod", "out", "0 0 1", axis="1 0 0") + link("far") + joint("lean", "base", "far", axis="1 1 0")
    )
    return content + frame("closing_x_1", "out", "0.1 0.2 0.3") + frame("closing_x_2", "far", "0.5 0.2 1.3", rpy)


@pytest.mark.parametrize(("rpy", "axis_b"), [("0 0 0.4", (0.0, 0.0, 1.0)), (f"{math.pi} 0 0", (0.0, 0.0, -1.0))])
def test_aligned_frames_are_a_hinge(tmp_path: Path, rpy: str, axis_b: tuple[float, ...]) -> None:
    draft = imported(tmp_path, spatial(rpy))
    ((loop, _),) = draft.loops
    assert (loop.type, loop.axis_b) == ("hinge", axis_b)
    assert has_note(draft.guessed, "hinge for loop x", "aligned")


def test_frames_that_are_not_aligned_are_a_point(tmp_path: Path) -> None:
    draft = imported(tmp_path, spatial("0.5 0 0"))
    ((loop, _),) = draft.loops
    assert loop.type == "point"
    assert has_note(draft.guessed, "point for loop x", "28.6 degrees apart")


def test_frames_that_mark_an_axis_are_a_hinge(tmp_path: Path) -> None:
    marks = frame("closing_x_1_z", "out", "0.1 0.2 0.4") + frame("closing_x_2_z", "far", "0.5 0.2 1.4")
    draft = imported(tmp_path, spatial("0 0 0") + marks)
    ((loop, comment),) = draft.loops
    assert (loop.name, loop.type) == ("x", "hinge")
    assert "mark its axis" in comment
    assert not has_note(draft.guessed, "loop x")


def test_pair_on_one_body_is_left_out(tmp_path: Path) -> None:
    content = (
        link("base")
        + link("arm")
        + joint("j", "base", "arm")
        + frame("closing_x_1", "arm")
        + frame("closing_x_2", "arm")
    )
    draft = imported(tmp_path, content)
    assert not draft.loops
    assert has_note(draft.left_out, "loop x", "one rigid body")


# --- example-parallel-robots ----------------------------------------------------------------------------------------

YAML = "closed_loop: [['end_A', 'end_B'], ['b_knee', 'end_B']]\ntype: ['3d', '6D']\nname_mot: ['a_hip']\n"


def legs() -> str:
    content = link("base")
    for side, x in (("a", -0.5), ("b", 0.5)):
        content += link(f"{side}_upper") + joint(f"{side}_hip", "base", f"{side}_upper", f"{x} 0 0")
        content += link(f"{side}_lower") + joint(f"{side}_knee", f"{side}_upper", f"{side}_lower", f"{x} 1 0")
    return content + frame("end_A", "a_lower", "1 1 0") + frame("end_B", "b_lower", "-1 1 0")


def test_robot_yaml_declares_loops_and_motors(tmp_path: Path) -> None:
    draft = imported(tmp_path, legs(), YAML)
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type, loop.frame_a, loop.frame_b) == ("end", "point", "end_A", "end_B")
    assert has_note(draft.left_out, "both of its frames are on one rigid body")  # b_knee and end_B move together
    assert draft.actuated == ["a_hip"]
    assert draft.independent is not None
    assert draft.independent[0] == "a_hip"
    assert draft.build_mechanism().d == 2


def test_robot_yaml_may_name_joints_as_frames(tmp_path: Path) -> None:
    draft = imported(tmp_path, legs(), "closed_loop: [[a_knee, b_knee]]\ntype: [3d]")
    ((loop, _),) = draft.loops
    assert (loop.frame_a, loop.frame_b) == ("joint:a_knee", "joint:b_knee")


def test_robot_yaml_without_a_type_is_a_weld_with_a_note(tmp_path: Path) -> None:
    draft = imported(tmp_path, legs(), "closed_loop: [[end_A, end_B]]")
    assert draft.loops[0][0].type == "weld"
    assert has_note(draft.guessed, "loop end is a weld", "has no type")


def test_robot_yaml_can_be_imported_itself(tmp_path: Path) -> None:
    imported(tmp_path, legs(), YAML)
    assert read(tmp_path / "robot.yaml").loops[0][0].frame_a == "end_A"


def test_robot_yaml_replaces_joints(tmp_path: Path) -> None:
    """A hinge becomes a ball or a universal joint at the same place; the product of rotations gives the body's pose."""
    yaml = "joint_name: [a_knee, b_knee, b_hip, gone]\njoint_type: [SPHERICAL, UJOINT_ZX, FIXED, SPHERICAL]"
    draft = imported(tmp_path, legs(), yaml)
    mechanism = draft.build_mechanism()
    assert mechanism.coordinates == ("a_hip", "a_knee_X", "a_knee_Y", "a_knee_Z", "b_knee_Z", "b_knee_X")
    values = {"a_knee_X": 0.3, "a_knee_Y": -0.4, "a_knee_Z": 0.5, "b_knee_Z": 0.7, "b_knee_X": -0.2}
    q = np.array([values.get(name, 0.0) for name in mechanism.coordinates])
    placement, _ = mechanism.tree.kinematics(q)
    expected = {
        "a_lower": (Rotation.from_euler("XYZ", [0.3, -0.4, 0.5]).as_matrix(), [-1.0, 1.0, 0.0]),
        "b_lower": (Rotation.from_euler("ZX", [0.7, -0.2]).as_matrix(), [1.0, 1.0, 0.0]),
    }
    for name, (rotation, place) in expected.items():
        at = mechanism.frames.find(name, name)
        assert_close(placement[at.joint, :9].reshape(3, 3).T @ at.rotation, rotation, 1e-15)
        assert_close(placement[at.joint, 9:], place, 1e-15)
    assert has_note(draft.guessed, "ball joint a_knee is three hinges", "a_knee_Y is +-90 degrees")
    assert has_note(draft.left_out, "joint_name gone")


def test_hinges_called_spherical_are_noted(tmp_path: Path) -> None:
    draft = imported(tmp_path, legs().replace("a_knee", "a_spherical_knee"), YAML)
    assert has_note(draft.guessed, "a_spherical_knee", "joint_type SPHERICAL")


# --- plain URDFs ----------------------------------------------------------------------------------------------------


def test_mimic_joints_are_couplings(tmp_path: Path) -> None:
    content = link("base") + link("one") + link("two") + joint("p", "base", "one")
    follow = joint("q", "base", "two", inner='<mimic joint="p" multiplier="-2" offset="0.1"/>')
    draft = imported(tmp_path, content + follow)
    assert not draft.loops
    assert not draft.couplings
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.closure.rows, mechanism.d) == (2, 1, 1)
    assert_close(mechanism.q_tree[1], -2 * mechanism.q_tree[0] + 0.1, 1e-12)
    broken = imported(tmp_path, content + follow.replace('joint="p"', 'joint="nobody"'))
    assert broken.build_mechanism().d == 2
    assert has_note(broken.left_out, "mimic of joint q: 'nobody'")


def test_base_gravity_and_meshes_are_noted(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="package://x/a.stl"/></geometry></visual>'
    draft = imported(tmp_path, link("base") + link("arm", BODY + mesh) + joint("j", "base", "arm"))
    assert has_note(draft.guessed, "base is fixed to the world", 'root = "free"')
    assert has_note(draft.guessed, "gravity is along -z")
    assert has_note(draft.left_out, "1 mesh files", "package://x/a.stl")


def test_urdf_without_loops_gets_a_template_of_a_loop(tmp_path: Path) -> None:
    """A note lists the conventions that import reads. The template closes the loop once it is completed."""
    plain = imported(tmp_path, FOUR_BAR)
    assert has_note(plain.guessed, "no loops", "[[loop]]", "frame_a", "<loop>", "robot.yaml", "closing_NAME_1")
    text = mechanism_text(plain)
    head, _, table = text.partition("# [[loop]]\n")
    filled = "[[loop]]\n" + re.sub("^# ?", "", table, flags=re.MULTILINE)
    for end, at, xyz in (("a", "rocker", "[1, 0, 0]"), ("b", "coupler", "[1, 0.5, 0]")):
        zero = f'frame_{end} = {{link = "{at}", xyz = [0.0, 0.0, 0.0]'
        assert zero in filled
        filled = filled.replace(zero, zero.replace("[0.0, 0.0, 0.0]", xyz))
    for name, content in (("mechanism.toml", head + filled), ("thing.urdf", plain.urdf_text())):
        (tmp_path / name).write_text(content, encoding="utf-8")
    mechanism = load(tmp_path)
    assert (mechanism.closure.rows, mechanism.rank, mechanism.d) == (5, 2, 1)
    closed = imported(tmp_path, FOUR_BAR + PIN.format(type="revolute", axis=""))
    assert not has_note(closed.guessed, "no loops")
    assert "# [[loop]]" not in mechanism_text(closed)


# --- rotations ------------------------------------------------------------------------------------------------------

angle = st.floats(-math.pi, math.pi)
near_the_pole = st.sampled_from([math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9, 1e-4 - math.pi / 2, math.pi / 2 - 5e-4])


@given(angle, angle | near_the_pole, angle)
def test_roll_pitch_yaw_are_exact_near_the_poles(roll: float, pitch: float, yaw: float) -> None:
    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    assert_close(from_rpy([roll, pitch, yaw]), rotation, 1e-14)
    assert_close(from_rpy(to_rpy(rotation)), rotation, 1e-14)
