"""Elements of a URDF: parsing of vectors and poses, and building of elements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import from_rpy, round_number, to_rpy
from ckc_pin.formats.robot import UNLIMITED, Body, JointAxis

__all__ = [
    "INERTIA_ENTRIES",
    "add_inertial",
    "add_joint",
    "add_link",
    "format_numbers",
    "from_pose",
    "make_visual",
    "make_visuals",
    "move_visual",
    "parse_origin",
    "parse_vector",
]

UNBOUNDED = 1e308  # the limit of a URDF that stands for none
INERTIA_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


# --- reading -------------------------------------------------------------------------------------------------------


def parse_origin(element: Element, where: str) -> pin.SE3:
    """Return the pose of an element's <origin>, the identity if there is none."""
    origin = element.find("origin")
    xyz, rpy = (parse_vector(origin, key, "0 0 0", f"{where}, <origin>") for key in ("xyz", "rpy"))
    return from_pose(xyz, rpy)


def parse_vector(element: Element | None, attribute: str, default: str, where: str) -> list[float]:
    """Return the three numbers of an attribute."""
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {attribute}={text!r} is not three finite numbers")
    return values


def from_pose(xyz: Sequence[float], rpy: Sequence[float]) -> pin.SE3:
    """Return a pose given as a URDF gives it."""
    return pin.SE3(from_rpy(rpy), np.array([float(x) for x in xyz]))


# --- building ------------------------------------------------------------------------------------------------------


def add_link(robot: Element, name: str) -> Element:
    """Add a link without mass and return it."""
    return SubElement(robot, "link", name=name)


def add_inertial(link: Element, body: Body) -> None:
    """Add an <inertial> to a link, unless mass and inertia are zero."""
    if body.mass or body.inertia.any():
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=format_numbers(body.centre), rpy="0 0 0")
        SubElement(inertial, "mass", value=repr(float(body.mass)))
        entries = {key: repr(float(body.inertia[at])) for key, at in INERTIA_ENTRIES.items()}
        SubElement(inertial, "inertia", entries)


def add_joint(
    robot: Element, name: str, kind: str, parent: str, child: str, origin: pin.SE3, axis: JointAxis | None = None
) -> None:
    """Add a <joint>; `origin` is the joint's frame in the parent link. An axis determines the kind."""
    limits = UNLIMITED if axis is None else axis.limits
    is_bounded = limits.lower is not None or limits.upper is not None
    if axis is not None:
        kind = "prismatic" if axis.slides else "revolute" if is_bounded else "continuous"
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    add_origin(joint, origin)
    if axis is None:
        return
    SubElement(joint, "axis", xyz=format_numbers(axis.direction))
    if is_bounded or limits.effort or limits.velocity:
        values = {"effort": limits.effort, "velocity": limits.velocity}
        if is_bounded:
            values["lower"] = -UNBOUNDED if limits.lower is None else limits.lower
            values["upper"] = UNBOUNDED if limits.upper is None else limits.upper
        SubElement(joint, "limit", {key: repr(float(value)) for key, value in values.items()})
    if axis.damping or axis.friction:
        SubElement(joint, "dynamics", damping=repr(axis.damping), friction=repr(axis.friction))
    if axis.mimic is not None:
        other, ratio, offset = axis.mimic
        SubElement(joint, "mimic", joint=other, multiplier=repr(ratio), offset=repr(offset))


def make_visual(pose: pin.SE3, shape: str, **sizes: str) -> Element:
    """Return a <visual>: a box, a cylinder, a sphere or a mesh at a pose."""
    visual = Element("visual")
    add_origin(visual, pose)
    SubElement(SubElement(visual, "geometry"), shape, sizes)
    return visual


def make_visuals(pose: pin.SE3, shape: str, edges: Iterable[float], radius: float, length: float) -> list[Element]:
    """Return a box, or a sphere, cylinder or capsule along z, as <visual> elements: a capsule is three of them."""
    if shape == "box":
        return [make_visual(pose, "box", size=format_numbers(edges))]
    ends = {"sphere": [0.0], "cylinder": [], "capsule": [-length / 2, length / 2]}[shape]
    places = [pose * pin.SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in ends]
    visuals = [make_visual(place, "sphere", radius=repr(radius)) for place in places]
    if shape != "sphere":
        visuals.insert(0, make_visual(pose, "cylinder", radius=repr(radius), length=repr(length)))
    return visuals


def move_visual(visual: Element, pose: pin.SE3) -> Element:
    """Return a <visual> in the axes of the frame in which `pose` is given."""
    moved = deepcopy(visual)
    origin = moved.find("origin")
    if origin is not None:
        moved.remove(origin)
    add_origin(moved, pose * parse_origin(visual, "<visual>"))
    return moved


def add_origin(element: Element, pose: pin.SE3) -> None:
    """Add an <origin>."""
    SubElement(element, "origin", xyz=format_numbers(pose.translation), rpy=format_numbers(to_rpy(pose.rotation)))


def format_numbers(values: Iterable[float]) -> str:
    """Return rounded numbers as the text of a URDF's attribute."""
    return " ".join(repr(round_number(float(x))) for x in values)
