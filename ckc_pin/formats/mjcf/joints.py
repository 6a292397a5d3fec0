"""A MuJoCo joint's place, axis, value in the reference pose, and range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import checked_direction, number
from ckc_pin.formats.mjcf.document import Attributes, Child, Document
from ckc_pin.formats.orientation import from_axis_angle
from ckc_pin.formats.urdf.elements import UNLIMITED, JointLimits
from ckc_pin.mechanism.tree import Array

__all__ = ["MjcfJoint", "is_free_root"]

TYPES = ("hinge", "slide", "ball", "free")


@dataclass(frozen=True)
class MjcfJoint:
    """A joint of a body, in the body's frame.

    Attributes
    ----------
    name : str
        Empty when the file has none.
    kind : str
        hinge, slide, ball or free.
    at, axis : (3,) arrays
        The point that it turns about; its direction, of length 1.
    ref : float
        Its value in the reference pose, rad or m.
    attributes : Attributes
    """

    name: str
    kind: str
    at: Array
    axis: Array
    ref: float
    attributes: Attributes

    @classmethod
    def read(cls, child: Child, body: str, document: Document) -> MjcfJoint:
        """Read a <joint> or <freejoint>."""
        element = child.element
        a = document.attributes(element, child.childclass, element.get("name", f"of {body}"))
        kind = "free" if element.tag == "freejoint" else a.get("type", "hinge")
        if kind not in TYPES:
            raise InputError(f"{a.where}: type={kind!r} is not one of {', '.join(TYPES)}")
        axis = checked_direction(a.numbers("axis", "0 0 1", 3)[:3], f"{a.where}: axis")
        axis = child.frame.rotation @ axis / np.linalg.norm(axis)
        at = np.zeros(3) if kind == "free" else child.frame.act(a.point("pos"))
        unit = {"hinge": document.radians, "slide": 1.0}.get(kind, 0.0)
        return cls(element.get("name", ""), kind, at, axis, a.number("ref") * unit, a)

    def unit(self, document: Document) -> float:
        """Return what the file's numbers of this joint are multiplied by, for radians and metres."""
        return document.radians if self.kind == "hinge" else 1.0

    def turned(self, value: float) -> pin.SE3:
        """Displacement that a value of the joint stands for."""
        if self.kind == "slide":
            return pin.SE3(np.eye(3), value * self.axis)
        return pin.SE3(from_axis_angle(self.axis, value) if value else np.eye(3), np.zeros(3))

    def limits(self, document: Document) -> JointLimits:
        """Return the range, where there is one."""
        a = self.attributes
        autolimits = document.compiler.flag("autolimits", "true") == "true"
        limited = a.flag("limited", "auto")
        if limited == "false" or (limited == "auto" and not (autolimits and "range" in a)):
            return UNLIMITED
        lower, upper = (number(x * self.unit(document)) for x in a.numbers("range", "0 0", 2)[:2])
        return JointLimits(lower, upper, max(map(abs, a.numbers("actuatorfrcrange", "0 0", 2))))


def is_free_root(joints: Sequence[MjcfJoint]) -> bool:
    """Whether three slides and a ball are a free joint: across each other, about the body's origin, nothing acting."""
    if [joint.kind for joint in joints] != ["slide", "slide", "slide", "ball"] or joints[3].at.any():
        return False
    if any(j.attributes.number(key) for j in joints for key in ("stiffness", "damping", "armature", "frictionloss")):
        return False
    axes = np.array([joint.axis for joint in joints[:3]])
    return bool(np.abs(axes @ axes.T - np.eye(3)).max() < 1e-12)
