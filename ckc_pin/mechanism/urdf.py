"""Read and check URDF files (untrusted input), and merge several trees into one URDF for Pinocchio.

XML is parsed strictly (`parse_xml`). Errors that Pinocchio accepts silently are rejected here: negative or NaN masses,
zero axes, duplicate names, unknown parents, two roots, two inertials of a link. Three cases need more care:

- A `continuous` joint becomes a revolute joint without limits, so that its coordinate is one number. Pinocchio would
  use a cosine and a sine.
- A `planar` joint is rejected, since Pinocchio ignores its axis.
- An inertial without mass or inertia is rejected. urdfdom, which reads URDFs for Pinocchio, would drop it with a line
  on stderr, and the link would have no mass.

Several trees are merged under a common root, with only the elements that dynamics needs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from xml.etree import ElementTree

import numpy as np
from msgspec import Struct, field

from ckc_pin.base.sources import parse_xml
from ckc_pin.errors import InputError, MechanismError

__all__ = [
    "INERTIA",
    "LIMITS",
    "WORLD",
    "Mimic",
    "TreeText",
    "UrdfTree",
    "by_name",
    "check_connected",
    "check_inertial",
    "check_joint",
    "check_range",
    "check_single_elements",
    "floats",
    "merge",
    "parse",
]

WORLD = "ckc_pin_world"  # common root link of several trees
DYNAMIC = {"link": ("inertial",), "joint": ("origin", "parent", "child", "axis", "limit", "dynamics")}


class TreeText(Struct, frozen=True):
    """Text of a URDF, and the pose and parent of its tree."""

    text: str
    source: str
    prefix: str = ""
    root: str = "fixed"
    parent: str = "world"
    xyz: Sequence[float] = (0.0, 0.0, 0.0)
    rpy: Sequence[float] = (0.0, 0.0, 0.0)


class UrdfTree(Struct):
    """A checked URDF.

    Attributes
    ----------
    root : Element
        The <robot> element, with prefixed names and continuous joints converted to revolute ones.
    base : str
        Name of the root link.
    mimic : list of (joint, other, ratio, offset)
    warnings : list of str
    """

    root: ElementTree.Element
    base: str
    mimic: list[Mimic] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def parse(text: str, source: str, prefix: str = "") -> UrdfTree:
    """Parse and check one URDF.

    Raises
    ------
    InputError
        Malformed XML, or an invalid number.
    MechanismError
        The joints do not form a tree, or a body or joint is physically impossible.
    """
    root = parse_xml(text, source)
    if root.tag != "robot":
        raise InputError(f"{source}: expected the root element <robot> of a URDF, got <{root.tag}>")
    if prefix:
        _add_prefix(root, prefix)
    links = by_name(root, "link", source)
    joints = by_name(root, "joint", source)
    tree = UrdfTree(root, "")
    for tag, elements in (("link", links), ("joint", joints)):
        for name, element in elements.items():
            check_single_elements(element, f"{source}: {tag} {name!r}")
    for name, link in links.items():
        check_inertial(name, link, source, tree.warnings)
    children: dict[str, str] = {}
    for name, joint in joints.items():
        child = check_joint(name, joint, links, source, tree.mimic)
        if child in children:
            raise MechanismError(f"{source}: link {child!r} has two parents: joints {children[child]!r} and {name!r}")
        children[child] = name
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        listed = ", ".join(map(repr, roots)) or "none: the joints form a circle"
        raise MechanismError(f"{source}: a URDF is a tree with one root link; roots found: {listed}")
    check_connected(roots[0], joints, links, source)
    tree.base = roots[0]
    return tree


def merge(trees: Sequence[TreeText]) -> UrdfTree:
    """Parse several trees and merge them into one, with the couplings and warnings of all trees."""
    parsed = [parse(t.text, t.source, t.prefix) for t in trees]
    if len(trees) == 1 and _stands_at_origin(trees[0]):
        merged = UrdfTree(ElementTree.Element("robot", name="world"), parsed[0].base)
        _append(merged, trees[0], parsed[0], set(), set())
    else:
        merged = _common_world(trees, parsed)
    return merged


def _common_world(trees: Sequence[TreeText], parsed: Sequence[UrdfTree]) -> UrdfTree:
    robot = ElementTree.Element("robot", name="world")
    ElementTree.SubElement(robot, "link", name=WORLD)
    merged = UrdfTree(robot, WORLD)
    links, joints = {WORLD}, set[str]()
    for text, tree in zip(trees, parsed, strict=True):
        parent = WORLD if text.parent == "world" else text.parent
        if parent not in links:
            choices = ", ".join(sorted(links - {WORLD})) or "only the world so far"
            raise MechanismError(
                f"{text.source}: its parent {text.parent!r} is not a link of an earlier tree: {choices}"
            )
        free = text.root == "free"
        name = f"{text.prefix}root" if free else f"{text.prefix}{tree.base}_to_{text.parent}"
        joint = ElementTree.SubElement(robot, "joint", name=name, type="floating" if free else "fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=tree.base)
        ElementTree.SubElement(joint, "origin", xyz=_numbers(text.xyz), rpy=_numbers(text.rpy))
        joints.add(name)
        _append(merged, text, tree, links, joints)
    return merged


def _append(merged: UrdfTree, text: TreeText, tree: UrdfTree, links: set[str], joints: set[str]) -> None:
    """Append the elements of a tree that dynamics needs, without visuals and controller data."""
    for element in tree.root:
        if element.tag not in DYNAMIC:
            continue
        name, names = element.attrib["name"], links if element.tag == "link" else joints
        if name in names:
            raise MechanismError(
                f"{text.source}: {element.tag} {name!r} is already in an earlier tree; give this [[tree]] a prefix"
            )
        names.add(name)
        bare = ElementTree.SubElement(merged.root, element.tag, element.attrib)
        bare.extend(part for tag in DYNAMIC[element.tag] if (part := element.find(tag)) is not None)
    merged.mimic += tree.mimic
    merged.warnings += tree.warnings


def _stands_at_origin(tree: TreeText) -> bool:
    return tree.root == "fixed" and tree.parent == "world" and not any([*tree.xyz, *tree.rpy])


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(x)) for x in values)


def _add_prefix(root: ElementTree.Element, prefix: str) -> None:
    for element in [*root.findall("link"), *root.findall("joint")]:
        if element.get("name"):
            element.set("name", prefix + element.attrib["name"])
    for joint in root.findall("joint"):
        for tag, attribute in (("parent", "link"), ("child", "link"), ("mimic", "joint")):
            reference = joint.find(tag)
            if reference is not None and reference.get(attribute):
                reference.set(attribute, prefix + reference.attrib[attribute])


Mimic = tuple[str, str, float, float]  # joint, other, ratio, offset

NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII
)  # the numbers that Python and C read in the same way
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
LIMITS = ("lower", "upper")
MIN_AXIS_LENGTH = 1e-9  # a shorter axis is taken for zero
INERTIA_TOLERANCE = 1e-18  # kg m^2: rounding error of a zero inertia that was rotated
SINGLE_ELEMENTS = {
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
}  # child elements that the URDF format allows once; a reader would take the first of several
JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating")


def by_name(root: ElementTree.Element, tag: str, source: str) -> dict[str, ElementTree.Element]:
    """Return the elements of one tag by name. Two elements of one name are an error."""
    elements: dict[str, ElementTree.Element] = {}
    for element in root.findall(tag):
        name = element.get("name")
        if not name:
            raise MechanismError(f"{source}: a <{tag}> has no name")
        if name in elements:
            raise MechanismError(f"{source}: two <{tag}> elements are called {name!r}")
        elements[name] = element
    if tag == "link" and not elements:
        raise MechanismError(f"{source}: no <link>")
    return elements


def floats(
    element: ElementTree.Element | None, attribute: str, count: int, default: str | None, where: str
) -> list[float]:
    """Read the numbers of an attribute. It is required if `default` is None."""
    text = default if element is None else element.get(attribute, default)
    if text is None:
        raise InputError(f"{where} has no {attribute}")
    values = _parse_numbers(text)
    if values is None or len(values) != count:
        raise InputError(f"{where}: {attribute}={text!r} is not {_finite_numbers(count)}")
    return list(values)


@lru_cache(maxsize=4096)
def _parse_numbers(text: str) -> tuple[float, ...] | None:
    """Return the finite numbers of a text, None if it has anything else. Rebuilt mechanisms repeat most texts."""
    words = text.split()
    values = tuple(float(word) for word in words if NUMBER.fullmatch(word))
    return values if len(values) == len(words) and all(map(math.isfinite, values)) else None


def _finite_numbers(count: int) -> str:
    return "a finite number" if count == 1 else f"{count} finite numbers"


def _check_origin(element: ElementTree.Element, where: str) -> None:
    origin = element.find("origin")
    floats(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    floats(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")


def _require_child(element: ElementTree.Element, tag: str, where: str) -> ElementTree.Element:
    child = element.find(tag)
    if child is None:
        raise InputError(f"{where} has no <{tag}>")
    return child


def check_single_elements(element: ElementTree.Element, where: str) -> None:
    """Reject elements that occur several times in a link or joint although the URDF format allows them once.

    Raises
    ------
    MechanismError
        An element occurs several times.
    """
    for tag in SINGLE_ELEMENTS[element.tag]:
        count = len(element.findall(tag))
        if count > 1:
            raise MechanismError(f"{where}: {count} <{tag}> elements; a URDF has one at most in <{element.tag}>")
    for inner in element:
        if inner.tag in SINGLE_ELEMENTS:
            check_single_elements(inner, f"{where}, <{inner.tag}>")


def check_inertial(name: str, link: ElementTree.Element, source: str, warnings: list[str]) -> None:
    """Reject a physically impossible mass or inertia. Warn of an inertia that only a planar model can have."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{source}: link {name!r}"
    _check_origin(inertial, where)
    (mass,) = floats(_require_child(inertial, "mass", f"{where}, <inertial>"), "value", 1, None, f"{where}, <mass>")
    if mass < 0:
        raise MechanismError(f"{where}: negative mass {mass:g} kg")
    tensor = _require_child(inertial, "inertia", f"{where}, <inertial>")
    xx, yy, zz, xy, xz, yz = (floats(tensor, key, 1, None, f"{where}, <inertia>")[0] for key in INERTIA)
    principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    size = float(np.abs(principal).max())
    if principal[0] < -(1e-9 * size + INERTIA_TOLERANCE):
        raise MechanismError(f"{where}: its inertia has a negative principal moment, {principal[0]:g} kg m^2")
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-6) + 1e-12 * size:
        warnings.append(
            f"link {name!r}: principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2 violate the "
            "triangle inequality; no body has them, a planar model may"
        )


def check_joint(
    name: str, joint: ElementTree.Element, links: dict[str, ElementTree.Element], source: str, mimics: list[Mimic]
) -> str:
    """Check a joint, rewrite it so that Pinocchio reads it correctly, and collect its mimic. Return its child link."""
    where = f"{source}: joint {name!r}"
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        problem = f"type {kind!r} is not supported" if kind else "it has no type"
        raise MechanismError(f"{where}: {problem}; valid: {', '.join(JOINT_TYPES)}")
    for tag in ("parent", "child"):
        link = _require_child(joint, tag, where).get("link")
        if link not in links:
            problem = f"its {tag} link {link!r} does not exist" if link else f"its <{tag}> names no link"
            raise MechanismError(f"{where}: {problem}; there are {', '.join(links)}")
    _check_origin(joint, where)
    if kind in ("revolute", "continuous", "prismatic"):
        element = joint.find("axis")
        axis = floats(element, "xyz", 3, "1 0 0" if element is None else None, f"{where}, <axis>")
        if math.hypot(*axis) < MIN_AXIS_LENGTH:
            raise MechanismError(f"{where}: its axis is zero")
        _limits(joint, kind, where)
        _damping(joint, where)
        _mimic(name, joint, where, mimics)
    return joint.find("child").attrib["link"]  # type: ignore[union-attr]


def _mimic(name: str, joint: ElementTree.Element, where: str, mimics: list[Mimic]) -> None:
    """Collect a mimic joint, which becomes a constraint row."""
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
    """Require damping and friction of at least zero, and write both, since urdfdom requires both."""
    dynamics = joint.find("dynamics")
    if dynamics is None:
        return
    for key in ("damping", "friction"):
        (value,) = floats(dynamics, key, 1, "0", f"{where}, <dynamics>")
        if value < 0:
            raise MechanismError(f"{where}: negative {key} {value:g}")
        dynamics.set(key, dynamics.get(key, "0"))


def _limits(joint: ElementTree.Element, kind: str, where: str) -> None:
    """Write the limits for Pinocchio. Without limits the range is infinite, where urdfdom would read [0, 0]."""
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
    """Require that the lower limit is not above the upper limit."""
    lower, upper = (floats(joint.find("limit"), key, 1, "0", f"{where}, <limit>")[0] for key in LIMITS)
    if lower > upper:
        raise MechanismError(f"{where}: its lower limit {lower:g} is above the upper one {upper:g}")


def check_connected(
    base: str, joints: dict[str, ElementTree.Element], links: dict[str, ElementTree.Element], source: str
) -> None:
    """Require that all links are connected to the root link."""
    below: dict[str, list[str]] = {}
    for joint in joints.values():
        below.setdefault(joint.find("parent").attrib["link"], []).append(joint.find("child").attrib["link"])  # type: ignore[union-attr]

    def walk(start: str) -> Iterator[str]:
        stack = [start]
        while stack:
            link = stack.pop()
            yield link
            stack += below.get(link, [])

    unreachable = set(links) - set(walk(base))
    if unreachable:
        raise MechanismError(f"{source}: links in a circle, not below {base!r}: {', '.join(sorted(unreachable))}")
