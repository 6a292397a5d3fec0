"""Elements of SDFormat: numbers, poses, mass properties, shapes, and the axes of joints."""

from __future__ import annotations

import math
from collections.abc import Callable
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import from_quaternion, from_rpy, make_unique, require_direction
from ckc_pin.formats.robot import Body, Joint, JointAxis, JointKind, JointLimits, Link, Robot, ball_axes
from ckc_pin.formats.urdf.elements import make_visual

__all__ = [
    "JOINT_KINDS",
    "attach_links",
    "parse_pose",
    "read_axes",
    "read_link",
    "read_number",
    "read_numbers",
    "read_pitch",
]

UNBOUNDED = ("lower", "upper", "effort", "velocity")  # may be infinite
NO_LIMIT = 1e16  # SDFormat's value for an unlimited joint
GAZEBO_AXES = {  # of joints without them: the format's direction for a hinge, ODE's and DART's for a universal joint
    "revolute2": {"axis2": "0 0 1"},
    "universal": {"axis": "1 0 0", "axis2": "0 1 0"},
}
DEFAULT_MASS, DEFAULT_INERTIA = 1.0, 1.0  # kg and kg m^2 of a link that does not give them
PERPENDICULAR_TOLERANCE = 1e-9
INERTIA_KEYS = (("ixx", 0, 0), ("iyy", 1, 1), ("izz", 2, 2), ("ixy", 0, 1), ("ixz", 0, 2), ("iyz", 1, 2))
JOINT_KINDS: dict[str, JointKind] = {
    **{"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"},
    **{"ball": "ball", "universal": "universal", "revolute2": "hinges", "screw": "screw"},
}


# --- numbers and poses ---------------------------------------------------------------------------------------------


def read_numbers(element: Element | None, tag: str, default: str, count: int, where: str) -> list[float]:
    """Return the numbers of a child element; `tag` may be a path, and empty for the element itself."""
    child = element if element is None or not tag else element.find(tag)
    text = default if child is None or not (child.text or "").strip() else (child.text or "")
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(x) or (tag in UNBOUNDED and x == x) for x in values):
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(
            f"{where}: <{tag or (element.tag if element is not None else '')}> {text.strip()!r} is not {what}"
        )
    return values


def read_number(element: Element | None, tag: str, default: float, where: str) -> float:
    """Return the number of a child element."""
    return read_numbers(element, tag, repr(default), 1, where)[0]


def parse_pose(element: Element | None, where: str) -> pin.SE3:
    """Return the pose of a <pose>, the identity if there is none."""
    if element is None:
        return pin.SE3.Identity()
    has_quaternion = element.get("rotation_format") == "quat_xyzw"
    default = "0 0 0 0 0 0 1" if has_quaternion else "0 0 0 0 0 0"
    values = read_numbers(element, "", default, 7 if has_quaternion else 6, where)
    if has_quaternion:
        rotation = from_quaternion([values[6], *require_quaternion(values[3:], where)[:3]])
    else:
        is_degrees = element.get("degrees", "false").lower() in ("true", "1")
        rotation = from_rpy([math.radians(x) for x in values[3:]] if is_degrees else values[3:])
    return pin.SE3(rotation, np.array(values[:3]))


def require_quaternion(values: list[float], where: str) -> list[float]:
    """Return a quaternion (x, y, z, w), whose length must not be zero."""
    if not any(values):
        raise InputError(f"{where}: <pose> has the quaternion 0 0 0 0, which is no rotation")
    return values


# --- links ---------------------------------------------------------------------------------------------------------


def read_link(element: Element, where: str, notes: dict[str, list[str]]) -> Link:
    """Read mass and shapes of a link. `notes` collects the links' names by what was assumed."""
    inertial, name = element.find("inertial"), element.get("name", "")
    if inertial is None or inertial.find("mass") is None or inertial.find("inertia") is None:
        notes.setdefault("mass or inertia of links is SDFormat's default, 1 kg and 1 kg m^2", []).append(name)
    if inertial is not None and inertial.get("auto", "false").lower() in ("true", "1"):
        raise InputError(f"{where}: <inertial auto> is computed from shapes by Gazebo only; expected mass and inertia")
    body = Body(read_number(inertial, "mass", DEFAULT_MASS, where), inertia=DEFAULT_INERTIA * np.eye(3))
    for key, row, column in INERTIA_KEYS:
        default = DEFAULT_INERTIA if row == column else 0.0
        body.inertia[row, column] = body.inertia[column, row] = read_number(inertial, f"inertia/{key}", default, where)
    pose = parse_pose(None if inertial is None else inertial.find("pose"), f"{where}, <inertial>")
    visuals = [visual for e in element.findall("visual") if (visual := _read_visual(e, where)) is not None]
    return Link(body.transformed(pose), visuals)


def _read_visual(element: Element, where: str) -> Element | None:
    """Return a shape as a URDF's <visual>; None if a URDF has no such shape."""
    pose = parse_pose(element.find("pose"), f"{where}, <visual>")
    geometry = element.find("geometry")
    shape = None if geometry is None or not len(geometry) else geometry[0]
    if shape is None:
        return None

    def text(tag: str, default: str) -> str:
        return " ".join((shape.findtext(tag) or default).split())

    if shape.tag in ("box", "sphere", "cylinder"):
        keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}[shape.tag]
        visual = make_visual(pose, shape.tag, **{key: text(key, "1 1 1" if key == "size" else "1") for key in keys})
    elif shape.tag == "mesh":
        visual = make_visual(pose, "mesh", filename=text("uri", ""), scale=text("scale", "1 1 1"))
    else:
        return None
    if colour := element.findtext("material/diffuse") or element.findtext("material/ambient"):
        SubElement(SubElement(visual, "material", name=""), "color", rgba=" ".join(colour.split()))
    return visual


# --- joints --------------------------------------------------------------------------------------------------------


def read_axes(
    element: Element, kind: str, rotate: Callable[[Element, Array], Array], where: str, notes: dict[str, list[str]]
) -> list[JointAxis]:
    """Return the axes of a joint in its frame.

    `rotate` gets an <axis> and its direction as it is written, and returns the direction in the joint's frame. `notes`
    collects the joints' names by what was assumed.
    """
    if kind in ("fixed", "ball"):
        return [] if kind == "fixed" else ball_axes()
    tags = ("axis", "axis2") if kind in ("universal", "revolute2") else ("axis",)
    axes = []
    for tag in tags:
        axis = element.find(tag)
        if axis is None:
            if tag not in GAZEBO_AXES.get(kind, {}):
                raise InputError(f"{where}: a joint of type {kind!r} has no <{tag}>")
            axis = Element(tag)
            SubElement(axis, "xyz").text = xyz = GAZEBO_AXES[kind][tag]
            notes.setdefault(f"<{tag}> of {kind} joints is Gazebo's default, {xyz}", []).append(element.get("name", ""))
        direction = rotate(axis, require_direction(read_numbers(axis, "xyz", "0 0 1", 3, where), f"{where}, <{tag}>"))
        axes.append(_read_axis(axis, direction / np.linalg.norm(direction), kind == "prismatic", f"{where}, <{tag}>"))
    if kind == "screw":
        axes.append(JointAxis(axes[0].direction, slides=True, suffix="_slide"))
        axes[0].suffix = "_turn"
    return axes


def _read_axis(element: Element, direction: Array, slides: bool, where: str) -> JointAxis:
    limit, dynamics = element.find("limit"), element.find("dynamics")
    lower, upper = (
        read_number(limit, key, default, where) for key, default in (("lower", -NO_LIMIT), ("upper", NO_LIMIT))
    )
    effort, velocity = (read_number(limit, key, -1.0, where) for key in ("effort", "velocity"))
    mimic = element.find("mimic")
    axis = JointAxis(
        direction,
        slides=slides,
        limits=JointLimits(
            lower if lower > -NO_LIMIT else None,
            upper if upper < NO_LIMIT else None,
            effort if 0 < effort < NO_LIMIT else 0.0,
            velocity if 0 < velocity < NO_LIMIT else 0.0,
        ),
        damping=read_number(dynamics, "damping", 0.0, where),
        friction=read_number(dynamics, "friction", 0.0, where),
        stiffness=read_number(dynamics, "spring_stiffness", 0.0, where),
        rest=read_number(dynamics, "spring_reference", 0.0, where),
    )
    if mimic is not None:
        ratio, offset, reference = (
            read_number(mimic, key, default, f"{where}, <mimic>")
            for key, default in (("multiplier", 1.0), ("offset", 0.0), ("reference", 0.0))
        )
        axis.mimic = (mimic.get("joint", ""), ratio, offset - ratio * reference)
    return axis


def attach_links(robot: Robot, parent: str, child: str, pose_of: Callable[[str], pin.SE3]) -> bool:
    """Add a weld of two links as they are drawn, as Gazebo's plugin DetachableJoint attaches them.

    `pose_of` returns the pose of a link in the world. If they are not two links of the robot, a warning says so, and
    the result is False.
    """
    if parent not in robot.links or child not in robot.links or parent == child:
        robot.warnings.append(
            f"Gazebo's DetachableJoint of {parent!r} and {child!r} is left out, because they are not two links of this "
            "robot; the mechanism has up to 6 freedoms more"
        )
        return False
    in_parent = pose_of(parent).inverse() * pose_of(child)
    name = make_unique(f"{parent}_{child}", robot.joints)
    robot.add_joint(Joint(name, "fixed", parent, child, in_parent, closes=True))
    return True


def read_pitch(element: Element, where: str) -> float:
    """Return the advance of a screw per radian, m. <thread_pitch> is Gazebo's older and inverse value, rad/m."""
    if element.find("screw_thread_pitch") is not None:
        return read_number(element, "screw_thread_pitch", 1.0, where) / (2 * math.pi)
    inverse = read_number(element, "thread_pitch", 1.0, where)
    if not inverse:
        raise InputError(f"{where}: <thread_pitch> is 0; expected rad/m")
    return -1 / inverse
