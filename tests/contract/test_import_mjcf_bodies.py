"""`ckc import` of a MuJoCo model's bodies: masses, meshes, springs, motors, names, and notes on omissions."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from ckc_pin.errors import InputError
from ckc_pin.formats.importing import read
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.spec import JointSpec, MotorSpec
from tests.conftest import assert_close
from tests.contract.helpers.models import TWO_ARMS, has_note, model, tetrahedron
from tests.contract.helpers.mujoco_twin import Twin

EXACT = 1e-12  # relative to the largest entry


# --- masses, springs, names -----------------------------------------------------------------------------------------


HULL = "<asset><mesh name='hull_shape' file='{}'/></asset>"


def test_missing_mesh_with_mass_is_noted(tmp_path: Path) -> None:
    geoms = "<geom type='mesh' mesh='hull_shape'/><geom type='sphere' size='.1' mass='2'/>"
    draft = model(tmp_path, f"<body name='hull'><joint name='j'/>{geoms}</body>", HULL.format("hull.stl"))
    assert has_note(draft.left_out, "hull (mesh hull_shape)", "<inertial>")
    assert draft.robot.find("link[@name='hull']/inertial/mass").get("value") == "2.0"


def test_body_of_a_missing_mesh_has_no_mass(tmp_path: Path) -> None:
    body = "<body name='hull'><joint name='j'/><geom type='mesh' mesh='hull_shape'/></body>"
    draft = model(tmp_path, body, HULL.format("hull.stl"))
    assert has_note(draft.left_out, "hull (mesh hull_shape)", "<inertial>")
    assert draft.robot.find("link[@name='hull']/inertial") is None


def test_mass_of_a_mesh_equals_mujocos(tmp_path: Path) -> None:
    (tmp_path / "hull.stl").write_bytes(tetrahedron())
    body = "<body name='hull'><joint name='j'/><geom type='mesh' mesh='hull_shape' density='6'/></body>"
    draft = model(tmp_path, body, HULL.format("hull.stl"))
    assert not draft.left_out[1:]
    assert_close(float(draft.robot.find("link[@name='hull']/inertial/mass").get("value")), 6 / 6, 1e-6)


@pytest.mark.parametrize("file", ["hull.stl", "damaged.stl", "../outside.stl"])
def test_meshes_without_mass_are_not_opened(tmp_path: Path, file: str) -> None:
    """The body's mass is declared, or the shape has none."""
    (tmp_path / "damaged.stl").write_text("version of a pointer", encoding="utf-8")
    declared = "<inertial pos='0 0 0' mass='3' diaginertia='1 1 1'/><geom type='mesh' mesh='hull_shape'/>"
    shown = "<geom type='mesh' mesh='hull_shape' mass='0'/><geom size='.1' mass='2'/>"
    bodies = f"<body name='a'><joint/>{declared}</body><body name='b'><joint/>{shown}</body>"
    draft = model(tmp_path, bodies, HULL.format(file))
    assert [float(m.get("value")) for m in draft.robot.iterfind("link/inertial/mass")] == [3.0, 2.0]
    assert draft.left_out == ["2 shapes that are not boxes, cylinders, capsules or spheres: not drawn"]


def test_shape_of_a_plugin_has_no_mass(tmp_path: Path) -> None:
    asset = "<asset><mesh name='gear'><plugin plugin='mujoco.sdf.gear'/></mesh></asset>"
    body = "<body name='wheel'><joint/><geom type='sdf' mesh='gear'><plugin plugin='mujoco.sdf.gear'/></geom></body>"
    draft = model(tmp_path, body, asset)
    assert has_note(draft.left_out, "wheel (mesh gear)", "<inertial>")


def test_meshes_outside_the_repository_are_not_opened(tmp_path: Path) -> None:
    (tmp_path / "inside" / ".git").mkdir(parents=True)
    (tmp_path / "hull.stl").write_bytes(tetrahedron())
    (tmp_path / "inside" / "link.stl").symlink_to(tmp_path / "hull.stl")
    body = "<body name='hull'><joint/><geom type='mesh' mesh='hull_shape'/><geom size='.1' mass='2'/></body>"
    (tmp_path / "inside" / "circle.stl").symlink_to("circle.stl")
    for file in ("../hull.stl", "link.stl", str(tmp_path / "hull.stl"), "circle.stl", "x" * 300 + ".stl"):
        assert has_note(model(tmp_path / "inside", body, HULL.format(file)).left_out, "hull (mesh hull_shape)")


def test_files_above_the_model_are_read_inside_its_repository(tmp_path: Path) -> None:
    """A mesh gives the mass: the tetrahedron of 1/6 m^3 at the hull's density of 6 kg/m^3."""
    (tmp_path / ".git").mkdir()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "hull.stl").write_bytes(tetrahedron())
    (tmp_path / "parts.xml").write_text("<mujocoinclude><default><geom density='6'/></default></mujocoinclude>")
    body = "<body name='hull'><joint/><geom type='mesh' mesh='hull_shape'/></body>"
    deep = tmp_path / "a" / "b" / "c" / "d"
    deep.mkdir(parents=True)
    up = "../" * 4
    draft = model(deep, body, HULL.format(f"{up}meshes/hull.stl") + f"<include file='{up}parts.xml'/>")
    assert_close(float(draft.robot.find("link[@name='hull']/inertial/mass").get("value")), 6 / 6, 1e-6)


def test_textures_are_not_opened(tmp_path: Path) -> None:
    looks = "<asset><texture name='t' type='2d' file='/etc/hostname'/><material name='m' texture='t'/></asset>"
    draft = model(tmp_path, "<body name='b'><joint name='j'/><geom size='.1' material='m'/></body>", looks)
    assert draft.left_out == []


@pytest.mark.parametrize(("rule", "mass"), [("auto", 3.0), ("true", 2.0), ("false", 3.0)])
def test_inertiafromgeom_selects_the_mass(tmp_path: Path, rule: str, mass: float) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        f"<mujoco><compiler inertiafromgeom='{rule}'/><worldbody><body name='b'><joint name='j'/>"
        "<inertial pos='0 0 0' mass='3' diaginertia='1 1 1'/><geom size='.1' mass='2'/></body></worldbody></mujoco>"
    )
    assert float(read(path).robot.find("link[@name='b']/inertial/mass").get("value")) == mass


def test_total_mass_and_inertia_groups_are_applied(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        "<mujoco><compiler settotalmass='12' inertiagrouprange='0 2'/><worldbody>"
        "<body name='a'><joint name='j'/><geom size='.1' mass='1'/><geom size='.3' mass='50' group='3'/></body>"
        "<body name='b'><joint name='k'/><geom size='.1' mass='2'/></body></worldbody></mujoco>"
    )
    masses = [float(m.get("value")) for m in read(path).robot.iterfind("link/inertial/mass")]
    assert_close(masses, [4.0, 8.0], EXACT)


def test_springs_armature_and_friction_are_imported(tmp_path: Path) -> None:
    joint = "<joint name='j' stiffness='30' springref='0.2' armature='0.01' frictionloss='0.5' damping='1'/>"
    draft = model(tmp_path, f"<body name='b'>{joint}<geom size='.1'/></body>")
    ((spring, _),) = draft.springs
    assert (spring.joint, spring.stiffness, spring.rest, spring.damping) == ("j", 30.0, 0.2, 0.0)
    assert draft.robot.find("joint[@name='j']/dynamics").attrib == {"damping": "1.0", "friction": "0.5"}
    assert [spec for spec, _ in draft.joints] == [JointSpec(name="j", armature=0.01)]
    assert draft.left_out == []


def test_active_ranges_are_stops_and_others_are_limits(tmp_path: Path) -> None:
    """As in MuJoCo. The range of a ball joint is left out with a note."""
    ranges = [("acts", "range='-1 2'"), ("rests", "range='-1 2' limited='false'"), ("none", "")]
    bodies = "".join(f"<body name='b{k}'><joint name='{k}' {r}/><geom size='.1'/></body>" for k, r in ranges)
    draft = model(
        tmp_path, f"{bodies}<body name='c'><joint name='ball' type='ball' range='0 1'/><geom size='.1'/></body>"
    )
    assert [spec for spec, _ in draft.joints] == [JointSpec(name="acts", stops=True)]
    mechanism = draft.build_mechanism()
    limits = dict(zip(mechanism.coordinates, np.transpose(mechanism.tree.limits()).tolist(), strict=True))
    assert limits["acts"] == limits["rests"] == [-1.0, 2.0]
    assert limits["none"] == [-np.inf, np.inf]
    assert (mechanism.joints.lower[0], mechanism.joints.upper[0], mechanism.joints.restitution[0]) == (-1.0, 2.0, 0.0)
    assert np.isinf(mechanism.joints.lower[1:]).all()
    assert draft.left_out == ["range of ball joint ball"]
    assert draft.guessed[:1] == ["ranges are hard stops without rebound; in MuJoCo they are soft: acts"]
    assert mechanism.warnings == [
        "joint limits are not stops, so a run may pass them: rests; stops = true in their [[joint]] adds stops"
    ]


def test_reference_pose_outside_ranges_is_assembled_inside(tmp_path: Path) -> None:
    bodies = "".join(
        f"<body name='b{k}'><joint name='j{k}' range='{r}'/><geom size='.1'/></body>"
        for k, r in enumerate(("-3 -1", "0 2"))
    )
    mechanism = model(tmp_path, bodies).build_mechanism()
    assert_close(mechanism.q_tree, [-1.0, 0.0], EXACT)
    assert has_note(mechanism.warnings, "beyond stops of joints", "j0 = -1 (without stops 0)")


@pytest.mark.parametrize("flag", ["frictionloss='disable'", "limit='disable'", "constraint='disable'"])
def test_disabled_friction_and_ranges_are_noted(tmp_path: Path, flag: str) -> None:
    """A note names them, because they act in the mechanism."""
    joint = "<joint name='j' range='-1 2' frictionloss='0.5'/>"
    draft = model(tmp_path, f"<body name='b'>{joint}<geom size='.1'/></body>", f"<option><flag {flag}/></option>")
    disabled = {"dry friction": not flag.startswith("limit"), "ranges of joints": not flag.startswith("friction")}
    for feature, is_disabled in disabled.items():
        assert has_note(draft.left_out, f"the model's flag that disables {feature}") is is_disabled


def test_unsupported_armature_is_noted(tmp_path: Path) -> None:
    """Of free and ball joints and of tendons."""
    bodies = """<body name='f'><joint name='free' type='free' armature='0.1'/><geom size='.1'/></body>
      <body name='c'><joint name='ball' type='ball'/><geom size='.1'/></body>
      <body name='d'><joint name='d'/><geom size='.1'/></body>"""
    rest = """<tendon><fixed name='belt' armature='0.2'><joint joint='d' coef='2'/></fixed></tendon>
      <actuator><motor name='turn' joint='ball' gear='3 0 0' armature='0.1'/></actuator>"""
    draft = model(tmp_path, bodies, rest)
    assert not draft.joints
    assert has_note(draft.left_out, "armature of free joint free")
    assert has_note(draft.left_out, "armature of ball joint ball")
    assert has_note(draft.left_out, "armature of tendon belt")


def test_unsupported_properties_of_joints_and_tendons_are_noted(tmp_path: Path) -> None:
    bodies = TWO_ARMS.replace('<joint name="a"', '<joint name="a" stiffness="1 2"')
    floating = "<body name='f' gravcomp='1'><joint name='free' type='free' damping='2'/><geom size='.1'/></body>"
    ends = '<site site="s1"/><site site="t1"/>'
    tendons = f"""<spatial name="band" stiffness="3" springlength="0 1">{ends}</spatial>
      <spatial name="rope" stiffness="3" armature="0.1">{ends}<site site="t2"/></spatial>"""
    draft = model(tmp_path, bodies + floating, f"<tendon>{tendons}</tendon>")
    assert has_note(draft.left_out, "quadratic", "joint a")
    assert has_note(draft.left_out, "damping of free joint free")
    assert has_note(draft.left_out, "gravity compensation", "f")
    assert has_note(draft.left_out, "stiffness or damping of tendon band")
    assert has_note(draft.left_out, "armature and stiffness or damping of tendon rope")
    assert len(draft.springs) == 1


def test_gears_and_limits_of_motors_are_imported(tmp_path: Path) -> None:
    """MuJoCo's joint force at a control equals the motor's torque through the gear and within its limits."""
    actuators = """<motor name="left" joint="a" gear="-20" forcerange="-1.5 2" forcelimited="true"/>
      <general name="right" joint="b" gainprm="3" ctrlrange="-2 2" ctrllimited="true"/>"""
    draft = model(tmp_path, TWO_ARMS, f"<actuator>{actuators}</actuator>")
    assert [spec for spec, _ in draft.motors] == [
        MotorSpec(name="left", joint="a", ratio=-20.0, torque_limit=[-1.5, 2.0]),
        MotorSpec(name="right", joint="b", torque_limit=6.0),
    ]
    assert draft.left_out == []
    mechanism = draft.build_mechanism()
    assert mechanism.actuated == ("left", "right")
    whole = mujoco.MjModel.from_xml_path(str(tmp_path / "thing.xml"))
    data = mujoco.MjData(whole)
    data.ctrl[:] = [1.1, 0.4]
    mujoco.mj_forward(whole, data)
    ours = mechanism.tree.named(mechanism.motors.force(np.array([1.1, 3 * 0.4])))
    for joint in "ab":
        assert ours[joint] == pytest.approx(data.joint(joint).qfrc_actuator[0], rel=1e-12)


def test_constant_forces_are_imported_and_gains_are_noted(tmp_path: Path) -> None:
    """A motor whose control is its force needs no note; an actuator without control input is a constant force."""
    actuators = """<motor joint="a"/><position joint="b" kp="9"/><motor site="s1"/>
      <general joint="c" gear="2" gainprm="0" biastype="affine" biasprm="1.5 0 0"/>"""
    draft = model(tmp_path, TWO_ARMS, f"<actuator>{actuators}</actuator>")
    assert draft.actuated == ["a", "b"]
    assert [(spec.joint, spec.value) for spec, _ in draft.forces] == [("c", 3.0)]
    assert has_note(draft.left_out, "gains", ": b")
    assert has_note(draft.left_out, "actuator on site s1")
    whole = mujoco.MjModel.from_xml_path(str(tmp_path / "thing.xml"))
    data = mujoco.MjData(whole)
    mujoco.mj_forward(whole, data)
    assert data.joint("c").qfrc_actuator[0] == 3.0


def test_muscles_and_plugins_are_motors(tmp_path: Path) -> None:
    """The length of a muscle is not computed, and no plugin is loaded."""
    rest = "<extension><plugin plugin='mujoco.pid'/></extension>"
    rest += "<actuator><muscle joint='a'/><plugin joint='b' plugin='mujoco.pid' actdim='1'/></actuator>"
    draft = model(tmp_path, TWO_ARMS, rest)
    assert draft.actuated == ["a", "b"]
    assert has_note(draft.left_out, "plugins")


def test_warnings_of_mujoco_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not written to a file in the current folder or to standard error."""
    monkeypatch.chdir(tmp_path)
    draft = model(tmp_path, "<body name='b'><joint name='j' armature='-1'/><geom size='.1'/></body>")
    assert has_note(draft.guessed, "MuJoCo warns", "singular")
    assert [path.name for path in tmp_path.iterdir()] == ["thing.xml"]


def test_missing_or_old_mujoco_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mujoco, "__version__", "3.3.0")
    with pytest.raises(InputError, match=r"MuJoCo 4 or later is needed, 3.3.0 is installed; update it with `pip"):
        model(tmp_path, "")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"thing.xml: reading MuJoCo's models needs MuJoCo; install it with `pip"):
        model(tmp_path, "")


def test_bodies_and_joints_without_names_are_named(tmp_path: Path) -> None:
    inner = "<body name='body_1'><joint/><joint type='slide'/><geom size='.1'/></body>"
    mechanism = model(tmp_path, f"<body><joint/><geom size='.1'/>{inner}</body>").build_mechanism()
    assert mechanism.coordinates == ("body_1_2_hinge", "body_1_hinge", "body_1_slide")


def test_included_file_is_part_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        "<mujocoinclude><body name='arm'><joint name='j'/><geom size='.1'/></body></mujocoinclude>"
    )
    assert model(tmp_path, "<include file='arm.xml'/>").build_mechanism().coordinates == ("j",)


def test_disabled_gravity_is_zero_and_other_disabled_features_are_noted(tmp_path: Path) -> None:
    body = "<body name='b'><joint name='j'/><geom size='.1'/></body>"
    flags = "gravity='disable' spring='disable' equality='disable' contact='disable'"
    draft = model(tmp_path, body, f"<option><flag {flags}/></option>")
    assert draft.gravity == (0.0, 0.0, 0.0)
    disabled = ("springs", "equality constraints")
    assert draft.left_out == [f"the model's flag that disables {feature}: they act here" for feature in disabled]


def test_unused_sites_are_points(tmp_path: Path) -> None:
    """At the positions that MuJoCo computes. Sites of a loop, a tendon or a motor are no points."""
    rest = """<equality><connect site1="s1" site2="t1"/></equality><actuator><motor site="t3"/></actuator>
      <tendon><spatial damping="1"><site site="s1"/><site site="side"/></spatial></tendon>"""
    bodies = TWO_ARMS.replace('<site name="s1"', '<site name="side"/><site name="s1"')
    draft = model(tmp_path, bodies, rest)
    assert [spec.name for spec, _ in draft.points] == ["s2", "t2"]
    twin = Twin(tmp_path / "thing.xml")
    q_tree, _ = twin.put(np.array([0.3, -0.4, 0.7]), np.zeros(3))
    twin.residuals(q_tree)
    for spec, _ in draft.points:
        assert_close(twin.pose(spec.frame).translation, twin.data.site(spec.name).xpos, EXACT)


def test_solids_are_drawn_in_the_urdf(tmp_path: Path) -> None:
    body = "<body name='b'><joint name='j'/><geom type='capsule' size='.1 .2'/><geom type='box' size='1 2 3'/></body>"
    draft = model(tmp_path, body)
    shapes = [e.tag for e in ElementTree.fromstring(draft.urdf_text()).iterfind("link[@name='b']/visual/geometry/*")]
    assert shapes == ["cylinder", "sphere", "sphere", "box"]


def test_actuated_joints_are_independent(tmp_path: Path) -> None:
    """An independent set with every actuated joint is preferred to the default choice."""
    rest = "<equality><connect site1='s1' site2='t1'/></equality><actuator><motor joint='c'/></actuator>"
    draft = model(tmp_path, TWO_ARMS, rest)
    assert draft.independent == ["c"]
    mechanism = draft.build_mechanism()
    assert mechanism.independent == mechanism.actuated == ("c",)
    pose = Pose(mechanism.tree, mechanism.closure.anchors, mechanism.q_tree)
    assert_close(mechanism.closure.phi(pose), 0.0, 1e-12)
