"""Loops and couplings in a URDF, which only their own programs read.

| element | program |
|---|---|
| <loop>, <coupling> | generalized_rbda |
| <loop_joint> with <link1>, <link2> | Drake before 2017, Isaac Sim |
| <constraint> with <parent_origin>, <child_origin> | urdfdom, pull request 264 |
| <drake:ball_constraint> | Drake |
| <joint> and the plugin DetachableJoint in <gazebo> | Gazebo |
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import make_unique, require_direction, round_number
from ckc_pin.formats.robot import Joint, JointAxis, JointKind, Robot, ball_axes
from ckc_pin.formats.sdf.elements import JOINT_KINDS, parse_pose, read_axes, read_number, read_pitch
from ckc_pin.formats.urdf.elements import from_pose, parse_vector
from ckc_pin.mechanism.spec import CouplingSpec

__all__ = ["LOOP_TAGS", "add_gazebo", "add_loops"]

LOOP_TAGS = ("loop", "loop_joint", "constraint", "drake:ball_constraint")
KINDS: dict[str, JointKind] = {
    **{"revolute": "revolute", "continuous": "revolute", "hinge": "revolute", "prismatic": "prismatic"},
    **{"spherical": "ball", "ball": "ball", "fixed": "fixed", "weld": "fixed"},
    **{"universal": "universal", "cylindrical": "cylindrical"},
}
ENDS = {  # elements of both ends, by tag: the link's element, its attribute, and the element of the pose
    "loop": (("predecessor", "link", "predecessor/origin"), ("successor", "link", "successor/origin")),
    "constraint": (("parent", "link", "parent_origin"), ("child", "link", "child_origin")),
}
OPPOSITE = 1e-12  # 1 + cosine of two axes that point against each other


def add_loops(robot: Robot, root: Element) -> Iterator[str]:
    """Add the loops and couplings of a URDF, and yield what they are called."""
    for tag, where_from in (("loop", "in generalized_rbda"), ("loop_joint", "in Drake's old format"),
                            ("constraint", "in urdfdom's proposal")):  # fmt: skip
        elements = root.findall(tag)
        for element in elements:
            robot.add_joint(_read_loop(element, robot))
        if elements:
            yield f"<{tag}> as {where_from}"
    for element in root.findall("coupling"):
        _add_coupling(element, robot, f"{robot.source}: coupling {element.get('name', '')!r}")
    if root.find("coupling") is not None:
        yield "<coupling> as in generalized_rbda"
    for element in root.findall("drake:ball_constraint"):
        _add_ball_constraint(element, robot)
    if root.find("drake:ball_constraint") is not None:
        yield "<drake:ball_constraint>"


def _read_loop(element: Element, robot: Robot) -> Joint:
    where, kind = f"{robot.source}: {element.tag} {element.get('name', '')!r}", element.get("type", "")
    links: list[str] = []
    poses: list[pin.SE3] = []
    if kind not in KINDS:
        raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {', '.join(KINDS)}")
    for end, (link, pose) in zip(("first", "second"), _ends(element, where), strict=True):
        _require_link(link, end if element.tag == "loop_joint" else ENDS[element.tag][len(links)][0], robot, where)
        links.append(link)
        poses.append(pose)
    name = make_unique(element.get("name") or "loop", robot.joints)
    if links[0] == links[1]:
        raise MechanismError(f"{where}: it connects link {links[0]!r} with itself; expected two links")
    axes = _read_axes(element, KINDS[kind], where)
    if element.tag == "constraint" and KINDS[kind] in ("revolute", "prismatic", "cylindrical"):
        other = _direction(element, "child_axis", where)
        poses[1] = poses[1] * pin.SE3(_rotate_onto(axes[0].direction, other), np.zeros(3))
    return replace(Joint.between(name, KINDS[kind], links, poses, axes), closes=True)


def _ends(element: Element, where: str) -> Iterator[tuple[str, pin.SE3]]:
    """Yield link and pose of both ends."""
    if element.tag == "loop_joint":
        ends = [child for child in element if child.tag in ("link1", "link2")]  # some writers call both of them link1
        if len(ends) != 2:
            raise InputError(f"{where}: expected <link1> and <link2>")
        for end in ends:
            xyz, rpy = (parse_vector(end, key, "0 0 0", f"{where}, <{end.tag}>") for key in ("xyz", "rpy"))
            yield end.get("link", ""), from_pose(xyz, rpy)
        return
    for tag, attribute, origin in ENDS[element.tag]:
        link, pose = element.find(tag), element.find(origin)
        xyz, rpy = (parse_vector(pose, key, "0 0 0", f"{where}, <{origin}>") for key in ("xyz", "rpy"))
        yield "" if link is None else link.get(attribute, ""), from_pose(xyz, rpy)


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


def _add_ball_constraint(element: Element, robot: Robot) -> None:
    where, links, poses = f"{robot.source}: <drake:ball_constraint>", [], []
    for body, point in (("body_A", "p_AP"), ("body_B", "p_BQ")):
        link = element.find(f"drake:ball_constraint_{body}")
        links.append("" if link is None else link.get("name", ""))
        _require_link(links[-1], body, robot, where)
        xyz = parse_vector(element.find(f"drake:ball_constraint_{point}"), "value", "0 0 0", where)
        poses.append(from_pose(xyz, (0.0, 0.0, 0.0)))
    name = make_unique("_".join(links), robot.joints)
    robot.add_joint(replace(Joint.between(name, "ball", links, poses, ball_axes()), closes=True))


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
    if len(before) == 1 and len(after) == 1:
        spec = CouplingSpec(joint=after[0], other=before[0], ratio=round_number(ratio))
        robot.couplings.append((spec, element.get("name", "")))
        return
    equation = f"{' + '.join(after) or '0'} = {ratio:g} ({' + '.join(before) or '0'})"
    robot.left_out.append(f"coupling {element.get('name', '')} of more than two joints: {equation}")


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
    dialects = []
    for gazebo in root.findall("gazebo"):
        joint = robot.joints.get(gazebo.get("reference", ""))
        for element in gazebo:
            if element.tag == "joint" and "reference" not in gazebo.attrib:
                robot.add_joint(_read_gazebo_joint(element, robot))
                dialects.append("<gazebo><joint>")
            elif element.tag in ("springStiffness", "springReference") and joint is not None and len(joint.axes) == 1:
                key = "stiffness" if element.tag == "springStiffness" else "rest"
                setattr(joint.axes[0], key, read_number(element, "", 0.0, f"{robot.source}: joint {joint.name!r}"))
            elif element.tag == "plugin" and (add := _plugin_reader(element)) is not None:
                dialects += add(element, robot)
            else:
                unread[f"<{element.tag}> of <gazebo>"] += 1
    return list(dict.fromkeys(dialects))


def _read_gazebo_joint(element: Element, robot: Robot) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"{robot.source}: <gazebo> joint {name!r}"
    if kind not in JOINT_KINDS:
        raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {', '.join(JOINT_KINDS)}")
    links = [(element.findtext(tag) or "").strip() for tag in ("parent", "child")]
    for link, end in zip(links, ("parent", "child"), strict=True):
        _require_link(link, end, robot, where)
    poses = robot.zero_poses()
    pose = poses[links[1]] * parse_pose(element.find("pose"), where)

    def rotate(axis: Element, direction: Array) -> Array:
        uses_model = (axis.findtext("use_parent_model_frame") or "").strip().lower() in ("true", "1")
        return pose.rotation.T @ direction if uses_model else direction

    axes = read_axes(element, kind, rotate, where)
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
    """Add a weld of two links at their poses at zero."""
    links = [(element.findtext(tag) or "").strip() for tag in ("parent_link", "child_link")]
    if any(link not in robot.links for link in links) or links[0] == links[1]:
        robot.warnings.append(
            f"Gazebo's DetachableJoint of {links[0]!r} and {links[1]!r} is left out, because they are not two links of "
            "this robot; the mechanism has up to 6 freedoms more"
        )
        return []
    poses = robot.zero_poses()
    name = make_unique(f"{links[0]}_{links[1]}", robot.joints)
    in_parent = poses[links[0]].inverse() * poses[links[1]]
    robot.add_joint(Joint(name, "fixed", links[0], links[1], in_parent, closes=True))
    return ["Gazebo's DetachableJoint"]
