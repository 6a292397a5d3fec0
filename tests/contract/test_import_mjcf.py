"""`ckc import` of MuJoCo models, against what MuJoCo itself makes of them (test_import_data/make_reference.py)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from ckc_pin.formats.importing import Draft, read
from ckc_pin.mechanism.pose import Pose
from tests.conftest import assert_close

DATA = Path(__file__).parent / "test_import_data"
REFERENCE = json.loads((DATA / "reference.json").read_text(encoding="utf-8"))["poses"]
EXACT = 1e-12


def model(tmp_path: Path, bodies: str, rest: str = "", name: str = "thing.xml") -> Draft:
    """Import a MuJoCo model of these bodies."""
    path = tmp_path / name
    path.write_text(f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody>{rest}</mujoco>", "utf-8")
    return read(path)


def said(notes: list[str], *fragments: str) -> bool:
    """Whether one note holds all fragments."""
    return any(all(fragment in note for fragment in fragments) for note in notes)


# --- the same machine in MuJoCo and here ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def machine() -> Draft:
    return read(DATA / "machine.xml")


def coordinates(joints: dict[str, list[float]]) -> dict[str, float]:
    """MuJoCo's numbers by our coordinates."""
    found: dict[str, float] = {}
    for name, values in joints.items():
        labels = {1: [name], 3: [f"{name}_{a}" for a in "xyz"]}.get(len(values)) or [
            f"{name}.{a}" for a in ("x", "y", "z", "rx", "ry", "rz")
        ]
        found |= dict(zip(labels, values, strict=True))
    return found


@pytest.mark.parametrize("reference", REFERENCE, ids=["reference", "near", "far", "farther"])
def test_bodies_are_where_mujoco_has_them(machine: Draft, reference: dict[str, Any]) -> None:
    """Mass, centre of mass and inertia of every body in world axes: geometry, joints, refs and solids are right."""
    tree, frames, _ = machine.tree()
    named = coordinates(reference["joints"])
    q_tree = tree.from_coordinates(np.array([named[label] for label in tree.coordinates]))
    placement, _ = tree.kinematics(q_tree)
    for name, theirs in reference["bodies"].items():
        inertial = machine.robot.find(f"link[@name='{name}']/inertial")
        assert inertial is not None, name
        assert_close(float(inertial.find("mass").get("value")), theirs["mass"], EXACT)
        at = frames.find(name, name)
        joint = pin.SE3(placement[at.joint, :9].reshape(3, 3).T, placement[at.joint, 9:])
        link = joint * pin.SE3(at.rotation, at.translation)
        centre = np.array([float(x) for x in inertial.find("origin").get("xyz").split()])
        assert_close(link.act(centre), theirs["centre"], EXACT)
        entry = {key: float(inertial.find("inertia").get(key)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")}
        inertia = np.array(
            [
                [entry["ixx"], entry["ixy"], entry["ixz"]],
                [entry["ixy"], entry["iyy"], entry["iyz"]],
                [entry["ixz"], entry["iyz"], entry["izz"]],
            ]
        )
        assert_close(link.rotation @ inertia @ link.rotation.T, theirs["inertia"], EXACT, relative=True)


@pytest.mark.parametrize("reference", REFERENCE, ids=["reference", "near", "far", "farther"])
def test_loops_miss_by_what_mujoco_says(machine: Draft, reference: dict[str, Any]) -> None:
    """The distance, and for a weld the angle, by which each equality constraint is not met anywhere."""
    tree, frames, _ = machine.tree()
    named = coordinates(reference["joints"])
    q_tree = tree.from_coordinates(np.array([named[label] for label in tree.coordinates]))
    placement, _ = tree.kinematics(q_tree)
    compared = set()
    for loop, _ in machine.loops:
        ends = []
        for frame in (loop.frame_a, loop.frame_b):
            f = frames.find(frame, loop.name)
            joint = pin.SE3(placement[f.joint, :9].reshape(3, 3).T, placement[f.joint, 9:])
            ends.append(joint * pin.SE3(f.rotation, f.translation))
        ours = [np.linalg.norm(ends[0].translation - ends[1].translation)]
        if loop.type == "weld":
            ours.append(np.linalg.norm(pin.log3(ends[0].rotation.T @ ends[1].rotation)))
        assert_close(ours, reference["misses"][loop.name], 1e-7)  # arccos near 0 loses half the digits
        compared.add(loop.name)
    for coupling, _ in machine.couplings:
        name = {"elbow": "geared", "swing": "held"}[coupling.joint]
        ours = named[coupling.joint] - coupling.ratio * named[coupling.other] - coupling.offset
        assert_close(ours, reference["misses"][name], EXACT)
        compared.add(name)
    assert compared == set(reference["misses"])


def test_the_reference_pose_is_the_guess(machine: Draft) -> None:
    """Refs and the free body's pose; the coordinates keep MuJoCo's numbers."""
    expected = coordinates(REFERENCE[0]["joints"])
    for label, value in expected.items():
        assert_close(machine.q_guess.get(label, 0.0), value, 1e-9)
    assert set(machine.q_guess) <= set(expected)


def test_what_else_the_machine_says(machine: Draft) -> None:
    assert machine.gravity == (0.0, -1.5, -9.7)
    assert machine.actuated == ["shoulder", "reach"]
    joints = {j.get("name"): j for j in machine.robot.findall("joint")}
    assert joints["shoulder"].find("dynamics").get("damping") == "0.2"
    assert joints["wrist"].find("dynamics") is None  # the nested class takes the damping away
    assert_close(float(joints["shoulder"].find("limit").get("lower")), math.radians(-170), EXACT)
    assert joints["reach"].get("type") == "prismatic"
    assert_close(float(joints["reach"].find("limit").get("upper")), 0.2, EXACT)
    assert joints["swing"].get("type") == "continuous"
    assert said(machine.guessed, "ball joint ball is three hinges, ball_x, ball_y, ball_z", "90 degrees")


# --- loops ----------------------------------------------------------------------------------------------------------

TWO_ARMS = """
<body name="left"><joint name="a" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
  <body name="rod" pos="1 0 .5"><joint name="b" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
    <site name="s1" pos="1 0 -.5"/><site name="s2" pos="1 .1 -.5"/></body></body>
<body name="right" pos="2 0 -1"><joint name="c" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
  <site name="t1" pos="0 0 1"/><site name="t2" pos="0 .1 1"/><site name="t3" pos="0 .2 1"/></body>
"""


def test_two_connects_of_one_pair_are_a_hinge(tmp_path: Path) -> None:
    ends = "body1='rod' body2='right'"
    connects = f"<connect name='e' {ends} anchor='1 0 -.5'/><connect {ends} anchor='1 .1 -.5'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, comment),) = draft.loops
    assert (loop.name, loop.type) == ("e", "hinge")
    assert loop.axis_a == loop.axis_b == (0.0, 1.0, 0.0)
    assert "two connects 100 mm apart" in comment
    mechanism = draft.mechanism()
    assert (mechanism.closure.rows, mechanism.rank, mechanism.d) == (5, 2, 1)


def test_two_connects_by_sites_either_way_round(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='t2' site2='s2'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, _),) = draft.loops
    assert loop.type == "hinge"
    assert draft.mechanism().d == 1


def test_two_connects_at_different_distances_stay_points(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='s2' site2='t3'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point", "point"]


def test_what_is_not_active_or_not_linear_or_not_known_is_said(tmp_path: Path) -> None:
    equality = """<equality><connect name="off" site1="s1" site2="t1" active="false"/>
      <joint name="cam" joint1="a" joint2="b" polycoef="0 1 0.5 0 0"/><tendon name="cable" tendon1="x"/></equality>"""
    draft = model(tmp_path, TWO_ARMS, equality + "<keyframe><key qpos='0 0 0'/></keyframe>")
    assert not draft.loops
    assert not draft.couplings
    assert said(draft.left_out, "off", "not active")
    assert said(draft.left_out, "joints a and b", "not linear")
    assert said(draft.left_out, "<tendon> cable")
    assert said(draft.left_out, "key frames")


def test_a_weld_without_torque_is_a_point(tmp_path: Path) -> None:
    draft = model(tmp_path, TWO_ARMS, "<equality><weld site1='s1' site2='t1' torquescale='0'/></equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point"]


def test_a_loop_within_one_rigid_body_is_left_out(tmp_path: Path) -> None:
    body = "<body name='a'><joint name='j'/><geom size='.1'/><body name='b' pos='1 0 0'><geom size='.1'/></body></body>"
    draft = model(tmp_path, body, "<equality><weld name='glue' body1='a' body2='b'/></equality>")
    assert not draft.loops
    assert said(draft.left_out, "loop glue", "one rigid body")


# --- roots ----------------------------------------------------------------------------------------------------------


def root(extra: str = "", ball: str = "") -> str:
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    slides = "".join(f"<joint name='{name}' type='slide' axis='{axis}'/>" for name, axis in axes.items())
    return (
        f"<body name='trunk' pos='0 0 1'>{slides}<joint name='turn' type='ball' {ball}/><geom size='.1'/>{extra}</body>"
    )


def test_three_slides_and_a_ball_are_a_free_root(tmp_path: Path) -> None:
    draft = model(tmp_path, root())
    mechanism = draft.mechanism()
    assert mechanism.coordinates == tuple(f"root.{a}" for a in ("x", "y", "z", "rx", "ry", "rz"))
    assert draft.q_guess == {"root.z": 1.0}
    assert said(draft.guessed, "three slides and the ball of body trunk")


@pytest.mark.parametrize("ball", ["damping='0.1'", "pos='0 0 0.2'", "armature='0.01'"])
def test_slides_and_a_ball_with_more_to_them_stay(tmp_path: Path, ball: str) -> None:
    assert model(tmp_path, root(ball=ball)).mechanism().coordinates == ("x", "y", "z", "turn_x", "turn_y", "turn_z")


def test_slides_that_are_used_stay(tmp_path: Path) -> None:
    draft = model(tmp_path, root(), "<actuator><motor joint='z'/></actuator>")
    assert draft.mechanism().coordinates[2] == "z"
    assert draft.actuated == ["z"]


# --- masses, springs, names -----------------------------------------------------------------------------------------


def test_masses_that_only_a_mesh_knows_are_said(tmp_path: Path) -> None:
    geoms = "<geom type='mesh' mesh='hull_shape'/><geom type='sphere' size='.1' mass='2'/>"
    draft = model(tmp_path, f"<body name='hull'><joint name='j'/>{geoms}</body>")
    assert said(draft.left_out, "hull (mesh hull_shape)", "<inertial>")
    assert draft.robot.find("link[@name='hull']/inertial/mass").get("value") == "2.0"


@pytest.mark.parametrize(("rule", "mass"), [("auto", 3.0), ("true", 2.0), ("false", 3.0)])
def test_which_mass_counts(tmp_path: Path, rule: str, mass: float) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        f"<mujoco><compiler inertiafromgeom='{rule}'/><worldbody><body name='b'><joint name='j'/>"
        "<inertial pos='0 0 0' mass='3' diaginertia='1 1 1'/><geom size='.1' mass='2'/></body></worldbody></mujoco>"
    )
    assert float(read(path).robot.find("link[@name='b']/inertial/mass").get("value")) == mass


def test_the_total_mass_and_the_groups_that_count(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        "<mujoco><compiler settotalmass='12' inertiagrouprange='0 2'/><worldbody>"
        "<body name='a'><joint name='j'/><geom size='.1' mass='1'/><geom size='.3' mass='50' group='3'/></body>"
        "<body name='b'><joint name='k'/><geom size='.1' mass='2'/></body></worldbody></mujoco>"
    )
    masses = [float(m.get("value")) for m in read(path).robot.iterfind("link/inertial/mass")]
    assert_close(masses, [4.0, 8.0], EXACT)


def test_springs_armature_and_friction(tmp_path: Path) -> None:
    joint = "<joint name='j' stiffness='30' springref='0.2' armature='0.01' frictionloss='0.5' damping='1'/>"
    draft = model(tmp_path, f"<body name='b'>{joint}<geom size='.1'/></body>")
    ((spring, _),) = draft.springs
    assert (spring.joint, spring.stiffness, spring.rest, spring.damping) == ("j", 30.0, 0.2, 0.0)
    assert draft.robot.find("joint[@name='j']/dynamics").attrib == {"damping": "1.0", "friction": "0.5"}
    assert said(draft.left_out, "armature", "j 0.01")


def test_bodies_and_joints_without_names_get_some(tmp_path: Path) -> None:
    inner = "<body name='body_1'><joint/><joint type='slide'/><geom size='.1'/></body>"
    mechanism = model(tmp_path, f"<body><joint/><geom size='.1'/>{inner}</body>").mechanism()
    assert mechanism.coordinates == ("body_1_2_hinge", "body_1_hinge", "body_1_slide")


def test_an_included_file_is_part_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        "<mujocoinclude><body name='arm'><joint name='j'/><geom size='.1'/></body></mujocoinclude>"
    )
    assert model(tmp_path, "<include file='arm.xml'/>").mechanism().coordinates == ("j",)


def test_gravity_switched_off(tmp_path: Path) -> None:
    body = "<body name='b'><joint name='j'/><geom size='.1'/></body>"
    assert model(tmp_path, body, "<option><flag gravity='disable'/></option>").gravity == (0.0, 0.0, 0.0)


def test_solids_are_drawn_and_the_urdf_is_one(tmp_path: Path) -> None:
    body = "<body name='b'><joint name='j'/><geom type='capsule' size='.1 .2'/><geom type='box' size='1 2 3'/></body>"
    draft = model(tmp_path, body)
    shapes = [e.tag for e in ElementTree.fromstring(draft.urdf()).iterfind("link[@name='b']/visual/geometry/*")]
    assert shapes == ["cylinder", "sphere", "sphere", "box"]


def test_motors_are_part_of_q(tmp_path: Path) -> None:
    """An independent set with every actuated joint, not the program's own choice."""
    rest = "<equality><connect site1='s1' site2='t1'/></equality><actuator><motor joint='c'/></actuator>"
    draft = model(tmp_path, TWO_ARMS, rest)
    assert draft.independent == ["c"]
    mechanism = draft.mechanism()
    assert mechanism.independent == mechanism.actuated == ("c",)
    pose = Pose(mechanism.tree, mechanism.closure.anchors, mechanism.q_tree)
    assert_close(mechanism.closure.phi(pose), 0.0, 1e-12)
