"""Building a URDF's elements from numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.formats.draft import number
from ckc_pin.formats.orientation import to_rpy

__all__ = ["UNLIMITED", "Body", "JointLimits", "add_inertial", "add_joint", "add_link", "add_shape", "numbers"]


@dataclass
class Body:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), both in one frame's axes."""

    mass: float
    centre: Array
    inertia: Array

    def moved(self, pose: pin.SE3) -> Body:
        """Return the body seen from the frame that `pose` is given in."""
        return Body(self.mass, pose.act(self.centre), pose.rotation @ self.inertia @ pose.rotation.T)


@dataclass(frozen=True)
class JointLimits:
    """Range of a joint (None: none) and its largest force."""

    lower: float | None = None
    upper: float | None = None
    effort: float = 0.0


UNLIMITED = JointLimits()


def add_link(robot: Element, name: str) -> Element:
    """Add a link, so far without mass."""
    return SubElement(robot, "link", name=name)


def add_inertial(link: Element, body: Body) -> None:
    """Give a link a body; one without mass and inertia says nothing."""
    if body.mass or body.inertia.any():
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=numbers(body.centre), rpy="0 0 0")
        SubElement(inertial, "mass", value=repr(float(body.mass)))
        pairs = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        SubElement(inertial, "inertia", {key: repr(float(body.inertia[at])) for key, at in pairs.items()})


def add_joint(
    robot: Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    origin: pin.SE3,
    axis: Sequence[float] | Array = (),
    limits: JointLimits = UNLIMITED,
    damping: float = 0.0,
    friction: float = 0.0,
) -> None:
    """Add a joint of a URDF's types."""
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    add_origin(joint, origin)
    if len(axis):
        SubElement(joint, "axis", xyz=numbers(axis))
    if limits.lower is not None and limits.upper is not None:
        limit = {"lower": repr(limits.lower), "upper": repr(limits.upper), "effort": repr(limits.effort)}
        SubElement(joint, "limit", {**limit, "velocity": "0"})
    if damping or friction:
        SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))


def add_shape(link: Element, pose: pin.SE3, shape: str, **sizes: str) -> None:
    """Add a visual: a box, a cylinder or a sphere."""
    visual = SubElement(link, "visual")
    add_origin(visual, pose)
    SubElement(SubElement(visual, "geometry"), shape, sizes)


def add_origin(element: Element, pose: pin.SE3) -> None:
    """Add an <origin>."""
    SubElement(element, "origin", xyz=numbers(pose.translation), rpy=numbers(to_rpy(pose.rotation)))


def numbers(values: Iterable[float]) -> str:
    """Return numbers as a URDF writes them."""
    return " ".join(repr(number(float(x))) for x in values)
