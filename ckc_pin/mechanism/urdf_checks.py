"""What Pinocchio would accept in silence, checked element by element, each with its name in the message.

Negative or NaN masses, zero axes, duplicate names, unknown parents, tensors that are none. Limits that a file
does not give are no limits: urdfdom would read [0, 0].
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np

from ckc_pin.errors import InputError, MechanismError

__all__ = [
    "INERTIA",
    "LIMITS",
    "Mimic",
    "by_name",
    "check_connected",
    "check_inertial",
    "check_joint",
    "check_range",
    "check_single_elements",
    "floats",
]

Mimic = tuple[str, str, float, float]  # joint, other, ratio, offset

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)  # what both Python and C read alike
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
LIMITS = ("lower", "upper")
SHORTEST = 1e-9  # an axis that is not zero by mistake
ROUNDING = 1e-18  # kg m^2: what is left of a zero tensor that was turned about
SINGLE_ELEMENTS = {
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
}  # what the URDF format allows once in an element and dynamics need; a reader takes the first of several
JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating")


def by_name(root: ElementTree.Element, tag: str, source: str) -> dict[str, ElementTree.Element]:
    """Return the elements of one tag by name; two of one name are refused."""
    found: dict[str, ElementTree.Element] = {}
    for element in root.findall(tag):
        name = element.get("name")
        if not name:
            raise MechanismError(f"{source}: a <{tag}> has no name")
        if name in found:
            raise MechanismError(f"{source}: two <{tag}> elements are called {name!r}")
        found[name] = element
    if tag == "link" and not found:
        raise MechanismError(f"{source}: no <link>")
    return found


def floats(
    element: ElementTree.Element | None, attribute: str, count: int, default: str | None, where: str
) -> list[float]:
    """Read an attribute's numbers; without a default it must be there."""
    text = default if element is None else element.get(attribute, default)
    if text is None:
        raise InputError(f"{where} has no {attribute}")
    words = text.split()
    values = [float(word) for word in words if NUMBER.fullmatch(word)]
    if len(values) != count or len(words) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {attribute}={text!r} is not {_finite_numbers(count)}")
    return values


def _finite_numbers(count: int) -> str:
    return "a finite number" if count == 1 else f"{count} finite numbers"


def _origin(element: ElementTree.Element, where: str) -> None:
    origin = element.find("origin")
    floats(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    floats(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")


def _needed(element: ElementTree.Element, tag: str, where: str) -> ElementTree.Element:
    found = element.find(tag)
    if found is None:
        raise InputError(f"{where} has no <{tag}>")
    return found


def check_single_elements(element: ElementTree.Element, where: str) -> None:
    """Refuse elements that the URDF format allows once in a link or joint and that are there several times.

    Raises
    ------
    MechanismError
        Names the element.
    """
    for tag in SINGLE_ELEMENTS[element.tag]:
        count = len(element.findall(tag))
        if count > 1:
            raise MechanismError(f"{where}: {count} <{tag}> elements; a URDF has one at most in <{element.tag}>")
    for inner in element:
        if inner.tag in SINGLE_ELEMENTS:
            check_single_elements(inner, f"{where}, <{inner.tag}>")


def check_inertial(name: str, link: ElementTree.Element, source: str, warnings: list[str]) -> None:
    """Refuse a body that cannot be; note one that no body can have but a planar model may."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{source}: link {name!r}"
    _origin(inertial, where)
    (mass,) = floats(_needed(inertial, "mass", f"{where}, <inertial>"), "value", 1, None, f"{where}, <mass>")
    if mass < 0:
        raise MechanismError(f"{where}: negative mass {mass:g} kg")
    tensor = _needed(inertial, "inertia", f"{where}, <inertial>")
    xx, yy, zz, xy, xz, yz = (floats(tensor, key, 1, None, f"{where}, <inertia>")[0] for key in INERTIA)
    principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    size = float(np.abs(principal).max())
    if principal[0] < -(1e-9 * size + ROUNDING):
        raise MechanismError(f"{where}: its inertia has a negative principal moment, {principal[0]:g} kg m^2")
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-6) + 1e-12 * size:
        warnings.append(
            f"link {name!r}: principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2 violate the "
            "triangle inequality; no body has them, a planar model may"
        )


def check_joint(
    name: str, joint: ElementTree.Element, links: dict[str, ElementTree.Element], source: str, mimics: list[Mimic]
) -> str:
    """Check a joint, make it one that Pinocchio reads as meant, note its coupling; return its child."""
    where = f"{source}: joint {name!r}"
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        found = f"type {kind!r} is not supported" if kind else "it has no type"
        raise MechanismError(f"{where}: {found}; valid: {', '.join(JOINT_TYPES)}")
    for tag in ("parent", "child"):
        link = _needed(joint, tag, where).get("link")
        if link not in links:
            found = f"its {tag} link {link!r} does not exist" if link else f"its <{tag}> names no link"
            raise MechanismError(f"{where}: {found}; there are {', '.join(links)}")
    _origin(joint, where)
    if kind in ("revolute", "continuous", "prismatic"):
        element = joint.find("axis")
        axis = floats(element, "xyz", 3, "1 0 0" if element is None else None, f"{where}, <axis>")
        if math.hypot(*axis) < SHORTEST:
            raise MechanismError(f"{where}: its axis is zero")
        _limits(joint, kind, where)
        _damping(joint, where)
        _mimic(name, joint, where, mimics)
    return joint.find("child").attrib["link"]  # type: ignore[union-attr]


def _mimic(name: str, joint: ElementTree.Element, where: str, mimics: list[Mimic]) -> None:
    """Take note of a coupling, which is a closure to us."""
    mimic = joint.find("mimic")
    if mimic is None:
        return
    other = mimic.get("joint")
    if not other:
        raise MechanismError(f"{where}: its <mimic> names no joint")
    (ratio,) = floats(mimic, "multiplier", 1, "1", f"{where}, <mimic>")
    (offset,) = floats(mimic, "offset", 1, "0", f"{where}, <mimic>")
    mimics.append((name, other, ratio, offset))


def _damping(joint: ElementTree.Element, where: str) -> None:
    """Damping and friction take energy away, they never give any; both absent is an error to urdfdom."""
    dynamics = joint.find("dynamics")
    if dynamics is None:
        return
    for key in ("damping", "friction"):
        (value,) = floats(dynamics, key, 1, "0", f"{where}, <dynamics>")
        if value < 0:
            raise MechanismError(f"{where}: negative {key} {value:g}")
        dynamics.set(key, dynamics.get(key, "0"))


def _limits(joint: ElementTree.Element, kind: str, where: str) -> None:
    """Leave Pinocchio a joint it cannot misread: an absent range is no range, not [0, 0]."""
    limit = joint.find("limit")
    unbounded = kind == "continuous" or limit is None or ("lower" not in limit.attrib and "upper" not in limit.attrib)
    if kind == "continuous":
        joint.set("type", "revolute")
    if limit is None:
        limit = ElementTree.SubElement(joint, "limit")
    for key, default in (("effort", "0"), ("velocity", "0")):
        floats(limit, key, 1, default, f"{where}, <limit>")
        limit.set(key, limit.get(key, default))
    if unbounded:
        limit.set("lower", "-1e308")
        limit.set("upper", "1e308")
    else:
        check_range(joint, where)


def check_range(joint: ElementTree.Element, where: str) -> None:
    """Refuse limits that leave nothing between them."""
    lower, upper = (floats(joint.find("limit"), key, 1, "0", f"{where}, <limit>")[0] for key in LIMITS)
    if lower > upper:
        raise MechanismError(f"{where}: its lower limit {lower:g} is above the upper one {upper:g}")


def check_connected(
    base: str, joints: dict[str, ElementTree.Element], links: dict[str, ElementTree.Element], source: str
) -> None:
    """Refuse links that hang together in a circle beside the tree."""
    below: dict[str, list[str]] = {}
    for joint in joints.values():
        below.setdefault(joint.find("parent").attrib["link"], []).append(joint.find("child").attrib["link"])  # type: ignore[union-attr]

    def walk(start: str) -> Iterator[str]:
        stack = [start]
        while stack:
            link = stack.pop()
            yield link
            stack += below.get(link, [])

    lost = set(links) - set(walk(base))
    if lost:
        raise MechanismError(f"{source}: links in a circle, not below {base!r}: {', '.join(sorted(lost))}")
