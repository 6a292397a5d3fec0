"""Read a URDF with its loops and motors, which programs declare in elements of their own or in files beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ckc_pin.base.sources import parse_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import choose_name, list_names, make_unique, require_direction
from ckc_pin.formats.robot import UNLIMITED, Body, Joint, JointAxis, JointKind, JointLimits, Link, Robot, ball_axes
from ckc_pin.formats.urdf.closing_frames import find_closing_frames
from ckc_pin.formats.urdf.elements import INERTIA_ENTRIES, parse_origin
from ckc_pin.formats.urdf.loop_closures_yaml import LOOP_CLOSURES_YAML, add_loop_closures_yaml
from ckc_pin.formats.urdf.loops import LOOP_TAGS, add_gazebo, add_loops
from ckc_pin.formats.urdf.motors import MOTOR_TAGS, add_control_mimics, add_motors
from ckc_pin.formats.urdf.robot_yaml import add_robot_yaml
from ckc_pin.mechanism.urdf import by_name, check_single_elements, floats

__all__ = ["find_urdf_beside", "read_urdf"]

ROBOT_YAML = "robot.yaml"
NO_LOOPS = (
    "no loops, because {}. To close one, write a table [[loop]] with name, type, frame_a and "
    "frame_b, such as the one at the end of mechanism.toml. Import itself recognizes <loop>, <loop_joint>, "
    "<constraint>, <drake:ball_constraint> and <gazebo><joint> in a URDF, closed_loop in a robot.yaml beside it "
    "(example-parallel-robots), a loop_closures.yaml, and pairs of links closing_NAME_1, closing_NAME_2 "
    "(onshape-to-robot)"
)
KINDS: dict[str, JointKind] = {
    **{"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"},
    **{"floating": "floating", "planar": "planar", "ball": "ball", "spherical": "ball"},
    **{"universal": "universal", "screw": "screw"},
}
READ = {  # other elements are left out with a note
    "robot": {"link", "joint", "drake:joint", "material", "gazebo", "coupling", *LOOP_TAGS, *MOTOR_TAGS},
    "link": {"inertial", "visual"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "drake:screw_thread_pitch"},
}


def read_urdf(text: str, path: Path) -> Robot:
    """Read a URDF and its loops. A robot.yaml or loop_closures.yaml in the same folder belongs to it."""
    root, source = parse_xml(text, str(path)), str(path)
    robot = Robot(name=choose_name(path, root.get("name", "")), origin=f"{path.name}, a URDF", source=source)
    robot.materials = root.findall("material")
    unread = Counter(f"<{e.tag}>" for e in root if e.tag not in READ["robot"])
    for name, element in by_name(root, "link", source).items():
        robot.links[name] = _read_link(element, f"{source}: link {name!r}", unread)
    points = [
        element.get("name", "")
        for element in root.findall("link[inertial]")
        if element.find("inertial/inertia") is None
    ]
    if points:
        robot.guessed.append(f"links without <inertia> are point masses, as in Drake: {list_names(points)}")
    _add_world(robot, root)
    _add_joints(robot, root, unread)
    gazebo = add_gazebo(robot, root, unread)
    dialects = [*add_loops(robot, root), *gazebo]
    if dialects:
        robot.origin = f"{path.name}, a URDF with {' and '.join(dialects)}"
    yaml_file = path.parent / ROBOT_YAML
    if yaml_file.is_file():
        robot.origin = f"{path.name} and {ROBOT_YAML}, as in example-parallel-robots"
        add_robot_yaml(robot, read_text(yaml_file, "YAML file"), ROBOT_YAML)
    closures_file = path.parent / LOOP_CLOSURES_YAML
    if closures_file.is_file():
        robot.origin = f"{path.name} and {LOOP_CLOSURES_YAML}, as from solidworks_urdf_exporter2"
        add_loop_closures_yaml(robot, read_text(closures_file, "YAML file"), LOOP_CLOSURES_YAML)
    if not robot.loops and not any(joint.closes for joint in robot.joints.values()):
        find_closing_frames(robot)
        if robot.loops or robot.untyped:
            robot.origin = f"{path.name}, a URDF with pairs of closing frames as from onshape-to-robot"
    _free_other_roots(robot)
    _set_independent(robot, root)
    add_control_mimics(robot, root)
    _check_mimics(robot)
    add_motors(robot, root, unread)
    robot.leave_out(unread)
    if not any(joint.kind == "floating" for joint in robot.joints.values()):
        robot.guessed.append(
            f'{robot.find_base()} is fixed to the world; for a free base write [[tree]] with root = "free"'
        )
    robot.guessed.append("gravity is along -z, because a URDF does not specify it")
    has_loops = robot.loops or robot.untyped or len(robot.joints) >= len(robot.links)
    if not has_loops and not robot.warnings:
        skipped = any(not what.endswith(("<link>", "<joint>")) for what in unread)
        why = (
            "no element that was read declares one; others are under left out" if skipped else "the URDF declares none"
        )
        robot.guessed.append(NO_LOOPS.format(why))
    meshes = [
        mesh.get("filename", "") for link in robot.links.values() for v in link.visuals for mesh in v.iter("mesh")
    ]
    if meshes:
        robot.left_out.append(f"{len(meshes)} mesh files, such as {meshes[0]}: they are not copied beside the new URDF")
    return robot


def find_urdf_beside(path: Path) -> Path:
    """Return the URDF to which a robot.yaml or loop_closures.yaml belongs."""
    urdfs = sorted(path.parent.glob("*.urdf"))
    candidates = [p for p in urdfs if p.name == "robot.urdf"] or urdfs
    if len(candidates) != 1:
        names = ", ".join(p.name for p in urdfs) or "none"
        raise InputError(f"{path}: expected one URDF in the same folder, got {names}; import the URDF itself instead")
    return candidates[0]


# --- links and joints ----------------------------------------------------------------------------------------------


def _read_link(element: Element, where: str, unread: Counter[str]) -> Link:
    check_single_elements(element, where)
    unread.update(f"<{child.tag}> of <link>" for child in element if child.tag not in READ["link"])
    link, inertial = Link(visuals=element.findall("visual")), element.find("inertial")
    if inertial is not None:
        (mass,) = floats(_require(inertial, "mass", f"{where}, <inertial>"), "value", 1, None, f"{where}, <mass>")
        tensor, inertia = inertial.find("inertia"), np.zeros((3, 3))
        for key, (row, column) in INERTIA_ENTRIES.items() if tensor is not None else ():
            inertia[row, column] = inertia[column, row] = floats(tensor, key, 1, None, f"{where}, <inertia>")[0]
        link.body = Body(mass, inertia=inertia).transformed(parse_origin(inertial, f"{where}, <inertial>"))
    return link


def _free_other_roots(robot: Robot) -> None:
    """Let trees beside the world move freely, as Drake does."""
    carried = {joint.child for joint in robot.joints.values() if not joint.closes}
    if "world" not in robot.links or "world" in carried:
        return
    parents = {joint.parent for joint in robot.joints.values()}
    for link in [name for name in robot.links if name not in carried and name in parents - {"world"}]:
        name = make_unique("root", robot.joints)
        robot.add_joint(Joint(name, "floating", "world", link))
        robot.guessed.append(
            f"{link} is free, with the coordinates {name}.x to {name}.rz, because no joint connects it to the world"
        )


def _require(element: Element, tag: str, where: str) -> Element:
    child = element.find(tag)
    if child is None:
        raise InputError(f"{where} has no <{tag}>")
    return child


def _add_world(robot: Robot, root: Element) -> None:
    """Add the link "world" if joints refer to it and the URDF does not have it."""
    joints = [*root.findall("joint"), *root.findall("drake:joint")]
    ends = [end.get("link") for joint in joints for tag in ("parent", "child") if (end := joint.find(tag)) is not None]
    closing = [
        end for joint in root.iterfind("gazebo/joint") for end in (joint.findtext("parent"), joint.findtext("child"))
    ]
    if "world" not in robot.links and "world" in (*ends, *closing):
        robot.links = {"world": Link(), **robot.links}
        robot.guessed.append('the link "world" is added, because joints refer to it')


def _add_joints(robot: Robot, root: Element, unread: Counter[str]) -> None:
    elements = by_name(root, "joint", robot.source) | by_name(root, "drake:joint", robot.source)
    for name, element in elements.items():
        where = f"{robot.source}: joint {name!r}"
        element.tag = "joint"
        check_single_elements(element, where)
        unread.update(f"<{child.tag}> of <joint>" for child in element if child.tag not in READ["joint"])
        kind = element.get("type", "")
        if kind not in KINDS:
            problem = f"type {kind!r} is not supported" if kind else "it has no type"
            raise MechanismError(f"{where}: {problem}; valid: {', '.join(KINDS)}")
        ends = [_require(element, tag, where).get("link", "") for tag in ("parent", "child")]
        axes = _read_axes(element, kind, where)
        pitch = floats(element.find("drake:screw_thread_pitch"), "value", 1, "0", where)[0] / (2 * np.pi)
        origin = parse_origin(element, where)
        robot.add_joint(Joint(name, KINDS[kind], ends[0], ends[1], origin, axes=axes, pitch=pitch))


def _read_axes(element: Element, kind: str, where: str) -> list[JointAxis]:
    if kind in ("fixed", "floating"):
        return []
    if KINDS[kind] == "ball":
        return ball_axes()
    if kind == "universal":  # Drake's turns about x, then y
        return [JointAxis(np.eye(3)[0]), JointAxis(np.eye(3)[1])]
    where_axis = f"{where}, <axis>"
    axis = element.find("axis")
    direction = require_direction(floats(axis, "xyz", 3, "1 0 0" if axis is None else None, where_axis), where_axis)
    direction /= np.linalg.norm(direction)
    if kind == "planar":
        one = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        one /= np.linalg.norm(one)
        slides = [JointAxis(d, slides=True, suffix=s) for d, s in ((one, "_x"), (np.cross(direction, one), "_y"))]
        return [*slides, JointAxis(direction, suffix="_turn")]
    limits, dynamics, mimic = UNLIMITED, element.find("dynamics"), element.find("mimic")
    if (limit := element.find("limit")) is not None:
        is_bounded = kind != "continuous" and ("lower" in limit.attrib or "upper" in limit.attrib)
        keys = ("lower", "upper", "effort", "velocity")
        lower, upper, effort, velocity = (floats(limit, key, 1, "0", f"{where}, <limit>")[0] for key in keys)
        limits = JointLimits(lower if is_bounded else None, upper if is_bounded else None, effort, velocity)
    first = JointAxis(
        direction,
        slides=kind == "prismatic",
        limits=limits,
        damping=floats(dynamics, "damping", 1, "0", f"{where}, <dynamics>")[0],
        friction=floats(dynamics, "friction", 1, "0", f"{where}, <dynamics>")[0],
    )
    if mimic is not None:
        ratio, offset = (
            floats(mimic, key, 1, d, f"{where}, <mimic>")[0] for key, d in (("multiplier", "1"), ("offset", "0"))
        )
        first.mimic = (mimic.get("joint", ""), ratio, offset)
    if kind == "screw":
        first.suffix = "_turn"
        return [first, JointAxis(direction, slides=True, suffix="_slide")]
    return [first]


def _check_mimics(robot: Robot) -> None:
    """Remove mimics whose joint does not exist or is fixed; the mechanism reads the others as couplings."""
    valid = []
    axes = robot.axes
    for name, axis in axes.items():
        if axis.mimic is None:
            continue
        if axis.mimic[0] in axes and axis.mimic[0] != name:
            valid.append(name)
        else:
            robot.left_out.append(f"mimic of joint {name}: {axis.mimic[0]!r} is not another moving joint")
            axis.mimic = None
    if valid:
        robot.guessed.append(f"mimic joints act as couplings and stay in the URDF: {list_names(valid)}")


def _set_independent(robot: Robot, root: Element) -> None:
    """Read the `independent` attributes of generalized_rbda. A joint without the attribute is independent."""
    texts = {joint.get("name", ""): joint.get("independent") for joint in root.findall("joint")}
    for name, text in texts.items():
        if text is not None and text.lower() not in ("true", "false"):
            raise InputError(f"{robot.source}: joint {name!r}: independent={text!r} is not true or false")
    if any(text is not None for text in texts.values()):
        robot.independent = [
            label
            for name, text in texts.items()
            if (text or "true").lower() == "true" and name in robot.joints
            for label in _labels(robot.joints[name])
        ]
        robot.why_independent = "declared by the joints of the URDF"


def _labels(joint: Joint) -> Iterator[str]:
    """Yield the labels of a joint's coordinates, without those that follow another joint."""
    if joint.kind == "floating":
        yield from (f"{joint.name}.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
    yield from (name for axis, name in zip(joint.axes, joint.coordinates, strict=True) if axis.mimic is None)
