"""What readers of URDFs share: elements by name, poses of <origin>, frames by name."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.orientation import from_rpy

__all__ = ["Names", "origin_of", "three"]


@dataclass
class Names:
    """Links and joints of a URDF by name.

    Attributes
    ----------
    links, joints : dict of str to Element
    above : dict of str to Element
        The joint that carries a link.
    split : dict of str to list of str
        Joints that became several, and their names now.
    """

    links: dict[str, Element]
    joints: dict[str, Element]
    above: dict[str, Element]
    split: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, robot: Element) -> Names:
        """Collect the names; the URDF was checked, so each is there once."""
        names = cls({}, {}, {})
        names._collect(robot)
        return names

    def replace(self, joint: str, robot: Element) -> None:
        """Follow the URDF after a joint was split."""
        before = set(self.joints)
        self._collect(robot)
        self.split[joint] = [name for name in self.joints if name not in before]

    @property
    def made(self) -> set[str]:
        """Joints that came out of a split."""
        return {name for names in self.split.values() for name in names}

    def near(self, name: str) -> str:
        """Return a hint at names like one that does not exist."""
        close = difflib.get_close_matches(name, [*self.links, *self.joints], 3)
        return f"; close to it: {', '.join(close)}" if close else ""

    def _collect(self, robot: Element) -> None:
        self.links = {e.attrib["name"]: e for e in robot.findall("link")}
        self.joints = {e.attrib["name"]: e for e in robot.findall("joint")}
        self.above = {j.find("child").attrib["link"]: j for j in self.joints.values()}  # type: ignore[union-attr]


def origin_of(element: Element, where: str) -> pin.SE3:
    """Return the pose of an element's <origin>."""
    origin = element.find("origin")
    xyz, rpy = (three(origin, key, "0 0 0", f"{where}, <origin>") for key in ("xyz", "rpy"))
    return pin.SE3(from_rpy(rpy), np.array(xyz))


def three(element: Element | None, attribute: str, default: str, where: str) -> list[float]:
    """Return three finite numbers of an attribute."""
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {attribute}={text!r} is not three finite numbers")
    return values
