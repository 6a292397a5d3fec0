"""Loops and couplings in a URDF, in elements that only their own programs read (`LOOP_TAGS`, <gazebo>)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import list_names, make_unique, require_direction, round_number
from ckc_pin.formats.robot import Joint, JointAxis, JointKind, Robot, ball_axes
from ckc_pin.formats.sdf.elements import (
    JOINT_KINDS,
    attach_links,
    parse_pose,
    read_axes,
    read_link,
    read_number,
    read_pitch,
)
from ckc_pin.formats.urdf.elements import from_pose, parse_vector
from ckc_pin.mechanism.spec import CouplingSpec

__all__ = ["LOOP_TAGS", "add_gazebo", "add_loops"]

LOOP_TAGS = {  # where they come from
    "loop": "<loop> as in generalized_rbda",
    "loop_joint": "<loop_joint> as in Drake's old format",
    "constraint": "<constraint> as in urdfdom's proposal",
    "drake:ball_constraint": "<drake:ball_constraint>",
}
KINDS: dict[str, JointKind] = {
    **{"revolute": "revolute", "continuous": "revolute", "hinge": "revolute", "prismatic": "prismatic"},
    **{"spherical": "ball", "ball": "ball", "fixed": "fixed", "weld": "fixed"},
    **{"universal": "universal", "cylindrical": "cylindrical"},
}
ENDS = {  # by tag: the element that names the link, its attribute, and the element of the pose
    "loop": (("predecessor", "link", "predecessor/origin"), ("successor", "link", "successor/origin")),
    "constraint": (("parent", "link", "parent_origin"), ("child", "link", "child_origin")),
    "drake:ball_constraint": tuple(
        (f"drake:ball_constraint_{body}", "name", f"drake:ball_constraint_{point}")
        for body, point in (("body_A", "p_AP"), ("body_B", "p_BQ"))
    ),
}
OPPOSITE = 1e-12  # 1 + cosine of two axes that point against each other


def add_loops(robot: Robot, root: Element) -> Iterator[str]:
    """Add the loops and couplings of a URDF, and yield what they are called."""
    for tag, title in LOOP_TAGS.items():
        elements = root.findall(tag)
        for element in elements:
            robot.add_joint(_read_loop(element, robot))
        if elements:
            yield title
    for element in root.findall("coupling"):
        _add_coupling(element, robot, f"{robot.source}: coupling {element.get('name', '')!r}")
    if root.find("coupling") is not None:
        yield "<coupling> as in generalized_rbda"


def _read_loop(element: Element, robot: Robot) -> Joint:
    where = f"{robot.source}: {element.tag} {element.get('name', '')!r}"
    kind = "ball" if element.tag == "drake:ball_constraint" else element.get("type", "")
    if kind not in KINDS:
        raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {', '.join(KINDS)}")
    ends = list(_ends(element, where))
    for end, link, _ in ends:
        _require_link(link, end, robot, where)
    (_, one, _), (_, other, pose) = ends
    if one == other:
        raise MechanismError(f"{where}: it connects link {one!r} with itself; expected two links")
    axes = _read_axes(element, KINDS[kind], where)
    if element.tag == "constraint" and KINDS[kind] in ("revolute", "prismatic", "cylindrical"):
        child_axis = _direction(element, "child_axis", where)
        pose = pose * pin.SE3(_rotate_onto(axes[0].direction, child_axis), np.zeros(3))
    name = make_unique(element.get("name") or f"{one}_{other}", robot.joints)
    return Joint(name, KINDS[kind], one, other, ends[0][2], pose, axes, closes=True)


def _ends(element: Element, where: str) -> Iterator[tuple[str, str, pin.SE3]]:
    """Yield name, link and pose of both ends."""
    if element.tag == "loop_joint":
        places = [child for child in element if child.tag in ("link1", "link2")]  # some writers call both link1
        if len(places) != 2:
            raise InputError(f"{where}: expected <link1> and <link2>")
        named: list[tuple[str, Element | None, str, Element | None]] = [(e.tag, e, "link", e) for e in places]
    else:
        named = [(tag, element.find(tag), key, element.find(pose)) for tag, key, pose in ENDS[element.tag]]
    for tag, link, key, pose in named:
        position = "value" if element.tag == "drake:ball_constraint" else "xyz"
        xyz, rpy = (parse_vector(pose, name, "0 0 0", f"{where}, <{tag}>") for name in (position, "rpy"))
        yield tag.removeprefix("drake:ball_constraint_"), "" if link is None else link.get(key, ""), from_pose(xyz, rpy)


def _require_link(link: str, end: str, robot: Robot, where: str) -> None:
    if link not in robot.links:
        raise MechanismError(f"{where}: {end} {link!r} is not a link; expected one of {', '.join(robot.links)}")


def _read_axes(element: Element, kind: JointKind, where: str) -> list[JointAxis]:
    if kind in ("fixed", "ball"):
        return [] if kind == "fixed" else ball_axes()
    first = _direction(element, "parent_axis" if element.tag == "constraint" else "axis", where)
    if kind == "cylindrical":
        return [JointAxis(first, slides=True, suffix="_slide"), JointAxis(first, suffix="_turn")]
    if kind == "universal":
        return [
            JointAxis(first),
            JointAxis(_direction(element, "child_axis" if element.tag == "constraint" else "axis2", where)),
        ]
    return [JointAxis(first, slides=kind == "prismatic")]


def _direction(element: Element, tag: str, where: str) -> Array:
    where_axis = f"{where}, <{tag}>"
    direction = require_direction(parse_vector(element.find(tag), "xyz", "1 0 0", where_axis), where_axis)
    return np.asarray(direction / np.linalg.norm(direction))


def _rotate_onto(one: Array, other: Array) -> Array:
    """Return the smallest rotation that turns a unit vector into another one."""
    if 1 + one @ other < OPPOSITE:
        normal = np.cross(one, np.eye(3)[np.argmin(np.abs(one))])
        return np.array(pin.AngleAxis(np.pi, normal / np.linalg.norm(normal)).matrix())
    return np.array(pin.Quaternion.FromTwoVectors(one, other).matrix())


# --- couplings of generalized_rbda ---------------------------------------------------------------------------------


def _add_coupling(element: Element, robot: Robot, where: str) -> None:
    """Add ratio * (joints to the predecessor) = joints to the successor, counted from their nearest common link."""
    chains = []
    for tag in ("predecessor", "successor"):
        end = element.find(tag)
        link = "" if end is None else end.get("link", "")
        _require_link(link, tag, robot, where)
        chains.append(list(_moving_joints_above(link, robot)))
    value = element.find("ratio")
    try:
        ratio = float("" if value is None else value.get("value", ""))
    except ValueError:
        raise InputError(f"{where}: expected <ratio> with a number as value") from None
    before, after = ([joint for joint in chain if joint not in other] for chain, other in (chains, chains[::-1]))
    name = element.get("name", "")
    if len(before) == 1 and len(after) == 1:
        robot.couplings.append((CouplingSpec(joint=after[0], other=before[0], ratio=round_number(ratio)), name))
    elif before or after:
        joints = dict.fromkeys(after, 1.0) | dict.fromkeys(before, -round_number(ratio))
        robot.couplings.append((CouplingSpec(name=name or None, joints=joints), ""))
    else:
        robot.left_out.append(f"coupling {name}: no joint lies between its links")


def _moving_joints_above(link: str, robot: Robot) -> Iterator[str]:
    """Yield the joints that are not fixed, from a link up to the root."""
    above = {joint.child: joint for joint in robot.joints.values() if not joint.closes}
    while (joint := above.pop(link, None)) is not None:
        if joint.kind != "fixed":
            yield joint.name
        link = joint.parent


# --- Gazebo --------------------------------------------------------------------------------------------------------


def add_gazebo(robot: Robot, root: Element, unread: Counter[str]) -> list[str]:
    """Add the joints, springs and couplings of <gazebo> elements, and return what they are called.

    Gazebo places a joint in its child, at the poses of the links at zero.
    """
    dialects, notes = list[str](), dict[str, list[str]]()
    drawn = {}  # poses of Gazebo's own links, relative to the robot's base at zero
    for element in root.iterfind("gazebo/link"):
        where = f"{robot.source}: <gazebo> link {element.get('name', '')!r}"
        robot.links[element.get("name", "")] = read_link(element, where, notes)
        drawn[element.get("name", "")] = parse_pose(element.find("pose"), where)
    for gazebo in root.findall("gazebo"):
        joint = robot.joints.get(gazebo.get("reference", ""))
        for element in gazebo:
            if element.tag == "joint" and "reference" not in gazebo.attrib:
                robot.add_joint(_read_gazebo_joint(element, robot, robot.zero_poses() | drawn, notes))
                dialects.append("<gazebo><joint>")
            elif element.tag == "link":
                dialects.append("<gazebo><link>")
            elif element.tag in ("springStiffness", "springReference") and joint is not None and len(joint.axes) == 1:
                key = "stiffness" if element.tag == "springStiffness" else "rest"
                setattr(joint.axes[0], key, read_number(element, "", 0.0, f"{robot.source}: joint {joint.name!r}"))
            elif element.tag == "plugin" and (add := _plugin_reader(element)) is not None:
                dialects += add(element, robot)
            else:
                unread[f"<{element.tag}> of <gazebo>"] += 1
    robot.guessed += [f"{what}: {list_names(names)}" for what, names in notes.items()]
    return list(dict.fromkeys(dialects))


def _read_gazebo_joint(
    element: Element, robot: Robot, poses: Mapping[str, pin.SE3], notes: dict[str, list[str]]
) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"{robot.source}: <gazebo> joint {name!r}"
    if kind not in JOINT_KINDS:
        raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {', '.join(JOINT_KINDS)}")
    links = [(element.findtext(tag) or "").strip() for tag in ("parent", "child")]
    for link, end in zip(links, ("parent", "child"), strict=True):
        _require_link(link, end, robot, where)
    pose = poses[links[1]] * parse_pose(element.find("pose"), where)

    def rotate(axis: Element, direction: Array) -> Array:
        uses_model = (axis.findtext("use_parent_model_frame") or "").strip().lower() in ("true", "1")
        return pose.rotation.T @ direction if uses_model else direction

    axes = read_axes(element, kind, rotate, where, notes)
    name = make_unique(name, robot.joints)
    joint = Joint.between(name, JOINT_KINDS[kind], links, [poses[link].inverse() * pose for link in links], axes)
    return replace(joint, closes=True, pitch=read_pitch(element, where) if kind == "screw" else 0.0)


def _plugin_reader(element: Element) -> Callable[[Element, Robot], list[str]] | None:
    name = f"{element.get('name', '')} {element.get('filename', '')}".lower().replace("_", "").replace("-", "")
    if "mimic" in name and element.find("mimicJoint") is not None:
        return _add_mimic_plugin
    return _add_detachable_joint if "detachablejoint" in name else None


def _add_mimic_plugin(element: Element, robot: Robot) -> list[str]:
    """Add the plugin's joint, which <mimicJoint> follows: mimicJoint = multiplier * joint + offset."""
    joint, follower = (robot.joints.get((element.findtext(tag) or "").strip()) for tag in ("joint", "mimicJoint"))
    where = f"{robot.source}: Gazebo mimic plugin"
    if joint is None or follower is None or len(joint.axes) != 1 or len(follower.axes) != 1 or joint is follower:
        names = f"{element.findtext('joint')!r} and {element.findtext('mimicJoint')!r}"
        robot.left_out.append(f"Gazebo mimic plugin of {names}, which are not two joints of one freedom")
        return []
    ratio, offset = (read_number(element, tag, d, where) for tag, d in (("multiplier", 1.0), ("offset", 0.0)))
    if follower.axes[0].mimic is None:
        follower.axes[0].mimic = (joint.name, ratio, offset)
    return ["Gazebo's mimic plugin"]


def _add_detachable_joint(element: Element, robot: Robot) -> list[str]:
    parent, child = ((element.findtext(tag) or "").strip() for tag in ("parent_link", "child_link"))
    is_attached = attach_links(robot, parent, child, robot.zero_poses().__getitem__)
    return ["Gazebo's DetachableJoint"] if is_attached else []
