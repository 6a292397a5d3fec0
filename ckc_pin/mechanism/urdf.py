"""Read URDF files, which are untrusted input, into one Pinocchio model.

XML is parsed strictly by expat, document types (and with them entities) are refused, and what
Pinocchio would accept in silence is checked here: negative or NaN masses, zero axes, duplicate names,
unknown parents, two roots, two inertials of a link. `continuous` joints are loaded as revolute ones without limits,
so that every joint is one number (Pinocchio would use a cosine and a sine); a `planar` joint is refused since
Pinocchio ignores its axis. An inertial without one of its numbers is refused too: urdfdom, which reads for
Pinocchio, drops it with a line on stderr and the link has no mass. Several trees become one URDF under a
common root, stripped to what dynamics need, before Pinocchio sees them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree

import numpy as np

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

WORLD = "ckc_pin_world"  # the common root of several trees
DYNAMIC = {"link": ("inertial",), "joint": ("origin", "parent", "child", "axis", "limit", "dynamics")}


@dataclass(frozen=True)
class TreeText:
    """A URDF's text and how it stands in the world."""

    text: str
    source: str
    prefix: str = ""
    root: str = "fixed"
    parent: str = "world"
    xyz: Sequence[float] = (0.0, 0.0, 0.0)
    rpy: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass
class UrdfTree:
    """A checked URDF.

    Attributes
    ----------
    root : Element
        The <robot>, names prefixed, continuous joints turned into revolute ones.
    base : str
        Its root link.
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
        Malformed XML, or a number that is none.
    MechanismError
        A tree that is none, or a body that cannot be.
    """
    root = parse_xml(text, source)
    if root.tag != "robot":
        raise InputError(f"{source}: the root element is <{root.tag}>, a URDF's is <robot>")
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
        found = ", ".join(map(repr, roots)) or "none: the joints form a circle"
        raise MechanismError(f"{source}: a URDF is a tree with one root link; roots found: {found}")
    check_connected(roots[0], joints, links, source)
    tree.base = roots[0]
    return tree


def merge(trees: Sequence[TreeText]) -> tuple[str, UrdfTree]:
    """Parse several trees and put them into one world.

    Returns
    -------
    text : str
        One URDF, ready for Pinocchio.
    tree : UrdfTree
        Its checks' findings, over all trees.
    """
    parsed = [parse(t.text, t.source, t.prefix) for t in trees]
    if len(trees) == 1 and _stands_at_origin(trees[0]):
        whole = UrdfTree(ElementTree.Element("robot", name="world"), parsed[0].base)
        _append(whole, trees[0], parsed[0], set(), set())
    else:
        whole = _common_world(trees, parsed)
    return ElementTree.tostring(whole.root, encoding="unicode"), whole


def _common_world(trees: Sequence[TreeText], parsed: Sequence[UrdfTree]) -> UrdfTree:
    robot = ElementTree.Element("robot", name="world")
    ElementTree.SubElement(robot, "link", name=WORLD)
    whole = UrdfTree(robot, WORLD)
    links, joints = {WORLD}, set[str]()
    for text, tree in zip(trees, parsed, strict=True):
        parent = WORLD if text.parent == "world" else text.parent
        if parent not in links:
            known = ", ".join(sorted(links - {WORLD})) or "only the world so far"
            raise MechanismError(f"{text.source}: its parent {text.parent!r} is no link of an earlier tree: {known}")
        free = text.root == "free"
        name = f"{text.prefix}root" if free else f"{text.prefix}{tree.base}_to_{text.parent}"
        joint = ElementTree.SubElement(robot, "joint", name=name, type="floating" if free else "fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=tree.base)
        ElementTree.SubElement(joint, "origin", xyz=_numbers(text.xyz), rpy=_numbers(text.rpy))
        joints.add(name)
        _append(whole, text, tree, links, joints)
    return whole


def _append(whole: UrdfTree, text: TreeText, tree: UrdfTree, links: set[str], joints: set[str]) -> None:
    """Append what dynamics need of a tree: no pictures, no controllers' data, nothing that is given twice."""
    for element in tree.root:
        if element.tag not in DYNAMIC:
            continue
        name, seen = element.attrib["name"], links if element.tag == "link" else joints
        if name in seen:
            raise MechanismError(
                f"{text.source}: {element.tag} {name!r} is already in an earlier tree; give this [[tree]] a prefix"
            )
        seen.add(name)
        bare = ElementTree.SubElement(whole.root, element.tag, element.attrib)
        bare.extend(part for tag in DYNAMIC[element.tag] if (part := element.find(tag)) is not None)
    whole.mimic += tree.mimic
    whole.warnings += tree.warnings


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
