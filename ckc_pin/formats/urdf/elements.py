"""Elements of a URDF: an index of links and joints by name, parsing of vectors and poses, and building of elements."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.draft import from_rpy, round_number, to_rpy

__all__ = [
    "UNLIMITED",
    "Body",
    "JointLimits",
    "UrdfIndex",
    "add_inertial",
    "add_joint",
    "add_link",
    "add_shape",
    "format_numbers",
    "parse_origin",
    "parse_vector",
]

MAX_SUGGESTIONS = 3  # similar names in a message about an unknown one
INERTIA_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


# --- reading -------------------------------------------------------------------------------------------------------


@dataclass
class UrdfIndex:
    """Links and joints of a URDF by name.

    Attributes
    ----------
    links, joints : dict of str to Element
    parent_joint : dict of str to Element
        The joint that carries a link, by the link's name.
    split_joints : dict of str to list of str
        Joints that were replaced by several, with the names of these.
    """

    links: dict[str, Element]
    joints: dict[str, Element]
    parent_joint: dict[str, Element]
    split_joints: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, robot: Element) -> UrdfIndex:
        """Index a URDF whose names are unique, as `ckc_pin.mechanism.urdf.parse` checks."""
        index = cls({}, {}, {})
        index._collect(robot)
        return index

    def update_after_split(self, joint: str, robot: Element) -> None:
        """Index the URDF again after one joint was replaced by several."""
        before = set(self.joints)
        self._collect(robot)
        self.split_joints[joint] = [name for name in self.joints if name not in before]

    @property
    def split_results(self) -> set[str]:
        """Names of the joints that replaced others."""
        return {name for names in self.split_joints.values() for name in names}

    def suggest_names(self, name: str) -> str:
        """Return the end of a message about an unknown name: similar names of links and joints, or nothing."""
        similar = difflib.get_close_matches(name, [*self.links, *self.joints], MAX_SUGGESTIONS)
        return f"; did you mean {', '.join(similar)}?" if similar else ""

    def _collect(self, robot: Element) -> None:
        self.links = {e.attrib["name"]: e for e in robot.findall("link")}
        self.joints = {e.attrib["name"]: e for e in robot.findall("joint")}
        self.parent_joint = {j.find("child").attrib["link"]: j for j in self.joints.values()}  # type: ignore[union-attr]


def parse_origin(element: Element, where: str) -> pin.SE3:
    """Return the pose of an element's <origin>, the identity if there is none.

    Raises
    ------
    InputError
        xyz or rpy is not three finite numbers.
    """
    origin = element.find("origin")
    xyz, rpy = (parse_vector(origin, key, "0 0 0", f"{where}, <origin>") for key in ("xyz", "rpy"))
    return pin.SE3(from_rpy(rpy), np.array(xyz))


def parse_vector(element: Element | None, attribute: str, default: str, where: str) -> list[float]:
    """Return the three numbers of an attribute.

    Raises
    ------
    InputError
        The attribute is not three finite numbers.
    """
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {attribute}={text!r} is not three finite numbers")
    return values


# --- building ------------------------------------------------------------------------------------------------------


@dataclass
class Body:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), the last two in the axes of one frame."""

    mass: float
    centre: Array
    inertia: Array

    def transformed(self, pose: pin.SE3) -> Body:
        """Return the body in the axes of the frame in which `pose` is given."""
        return Body(self.mass, pose.act(self.centre), pose.rotation @ self.inertia @ pose.rotation.T)


@dataclass(frozen=True)
class JointLimits:
    """Range of a joint (rad or m; None: unlimited) and its largest force or torque."""

    lower: float | None = None
    upper: float | None = None
    effort: float = 0.0


UNLIMITED = JointLimits()


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
    robot: Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    origin: pin.SE3,
    *,
    axis: Sequence[float] | Array = (),
    limits: JointLimits = UNLIMITED,
    damping: float = 0.0,
    friction: float = 0.0,
) -> None:
    """Add a <joint> of a type that URDF has; `origin` is the joint's frame in the parent link."""
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    add_origin(joint, origin)
    if len(axis):
        SubElement(joint, "axis", xyz=format_numbers(axis))
    if limits.lower is not None and limits.upper is not None:
        limit = {"lower": repr(limits.lower), "upper": repr(limits.upper), "effort": repr(limits.effort)}
        SubElement(joint, "limit", {**limit, "velocity": "0"})
    if damping or friction:
        SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))


def add_shape(link: Element, pose: pin.SE3, shape: str, **sizes: str) -> None:
    """Add a <visual> to a link: a box, a cylinder or a sphere at a pose."""
    visual = SubElement(link, "visual")
    add_origin(visual, pose)
    SubElement(SubElement(visual, "geometry"), shape, sizes)


def add_origin(element: Element, pose: pin.SE3) -> None:
    """Add an <origin>."""
    SubElement(element, "origin", xyz=format_numbers(pose.translation), rpy=format_numbers(to_rpy(pose.rotation)))


def format_numbers(values: Iterable[float]) -> str:
    """Return rounded numbers as the text of a URDF's attribute."""
    return " ".join(repr(round_number(float(x))) for x in values)
