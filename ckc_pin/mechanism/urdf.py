"""URDF files, from strangers, to one Pinocchio model.

XML is parsed strictly by expat, document types (and with them entities) are refused, and what
Pinocchio would accept in silence is checked here: negative or NaN masses, zero axes, duplicate names,
unknown parents, two roots. `continuous` joints are loaded as revolute ones without limits, so that
every joint is one number (Pinocchio would use a cosine and a sine); a `planar` joint is refused since
Pinocchio ignores its axis. Several trees become one URDF under a common root before Pinocchio sees them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from ckc_pin.errors import InputError, MechanismError

__all__ = ["WORLD", "TreeText", "UrdfTree", "merge", "parse", "strict_xml"]

WORLD = "ckc_pin_world"  # the common root of several trees

MAX_DEPTH = 300  # of nested elements; ElementTree writes by recursion

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating")


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
    mimic: list[tuple[str, str, float, float]] = field(default_factory=list)
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
    root = strict_xml(text, source)
    if root.tag != "robot":
        raise InputError(f"{source}: the root element is <{root.tag}>, a URDF's is <robot>")
    if prefix:
        _add_prefix(root, prefix)
    links = _by_name(root, "link", source)
    joints = _by_name(root, "joint", source)
    tree = UrdfTree(root, "")
    for name, link in links.items():
        _check_inertial(name, link, source, tree.warnings)
    children: dict[str, str] = {}
    for name, joint in joints.items():
        child = _check_joint(name, joint, links, source, tree)
        if child in children:
            raise MechanismError(f"{source}: link {child!r} has two parents: joints {children[child]!r} and {name!r}")
        children[child] = name
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none: the joints form a circle"
        raise MechanismError(f"{source}: a URDF is a tree with one root link; roots found: {found}")
    _check_connected(roots[0], joints, links, source)
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
    whole = parsed[0] if len(trees) == 1 and _stands_at_origin(trees[0]) else _common_world(trees, parsed)
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
        for element in tree.root:
            seen = {"link": links, "joint": joints}.get(element.tag)
            if seen is not None:
                if element.get("name") in seen:
                    raise MechanismError(
                        f"{text.source}: {element.tag} {element.get('name')!r} is already in an earlier tree; "
                        "give this [[tree]] a prefix"
                    )
                seen.add(str(element.get("name")))
            robot.append(copy.copy(element))
        whole.mimic += tree.mimic
        whole.warnings += tree.warnings
    return whole


def _stands_at_origin(tree: TreeText) -> bool:
    return tree.root == "fixed" and tree.parent == "world" and not any([*tree.xyz, *tree.rpy])


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(x)) for x in values)


def strict_xml(text: str, source: str) -> ElementTree.Element:
    """Parse XML from a stranger: no recovery, no document type, hence no entities, no abyss of nested elements.

    Raises
    ------
    InputError
        With the line, where expat has one.
    """
    depth = 0

    def refuse(name: str, *_: object) -> None:
        raise InputError(f"{source}: a document type declaration ({name}) is not accepted")

    def enter(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise InputError(f"{source}: elements nested more than {MAX_DEPTH} deep are not accepted")

    def leave(_: str) -> None:
        nonlocal depth
        depth -= 1

    checker = expat.ParserCreate()
    checker.StartDoctypeDeclHandler = refuse
    checker.StartElementHandler, checker.EndElementHandler = enter, leave
    try:
        checker.Parse(text.encode(), True)
        return ElementTree.fromstring(text.encode())
    except (expat.ExpatError, ElementTree.ParseError) as error:
        raise InputError(f"{source}: malformed XML: {error}") from None


def _add_prefix(root: ElementTree.Element, prefix: str) -> None:
    for element in [*root.findall("link"), *root.findall("joint")]:
        if element.get("name"):
            element.set("name", prefix + element.attrib["name"])
    for joint in root.findall("joint"):
        for tag, attribute in (("parent", "link"), ("child", "link"), ("mimic", "joint")):
            reference = joint.find(tag)
            if reference is not None and reference.get(attribute):
                reference.set(attribute, prefix + reference.attrib[attribute])


def _by_name(root: ElementTree.Element, tag: str, source: str) -> dict[str, ElementTree.Element]:
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


def _floats(element: ElementTree.Element | None, attribute: str, count: int, default: str, where: str) -> list[float]:
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise InputError(f"{where}: {attribute}={text!r} is not {count} numbers") from None
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {attribute}={text!r} is not {count} finite numbers")
    return values


def _origin(element: ElementTree.Element, where: str) -> None:
    origin = element.find("origin")
    _floats(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    _floats(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")


def _check_inertial(name: str, link: ElementTree.Element, source: str, warnings: list[str]) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{source}: link {name!r}"
    _origin(inertial, where)
    (mass,) = _floats(inertial.find("mass"), "value", 1, "0", f"{where}, <mass>")
    if mass < 0:
        raise MechanismError(f"{where}: negative mass {mass:g} kg")
    tensor = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (
        _floats(tensor, key, 1, "0", f"{where}, <inertia>")[0] for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    size = float(np.abs(principal).max())
    if principal[0] < -1e-9 * size:
        raise MechanismError(f"{where}: its inertia has a negative principal moment, {principal[0]:g} kg m^2")
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-6) + 1e-12 * size:
        warnings.append(
            f"link {name!r}: principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2 violate the "
            "triangle inequality; no body has them, a planar model may"
        )


def _check_joint(
    name: str, joint: ElementTree.Element, links: dict[str, ElementTree.Element], source: str, tree: UrdfTree
) -> str:
    where = f"{source}: joint {name!r}"
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        raise MechanismError(f"{where}: type {kind!r} is not supported; valid: {', '.join(JOINT_TYPES)}")
    ends = {}
    for tag in ("parent", "child"):
        element = joint.find(tag)
        link = None if element is None else element.get("link")
        if link not in links:
            raise MechanismError(f"{where}: its {tag} link {link!r} does not exist; there are {', '.join(links)}")
        ends[tag] = str(link)
    _origin(joint, where)
    if kind in ("revolute", "continuous", "prismatic"):
        axis = _floats(joint.find("axis"), "xyz", 3, "1 0 0", f"{where}, <axis>")
        if not any(axis):
            raise MechanismError(f"{where}: its axis is zero")
        _limits(joint, kind, where)
        mimic = joint.find("mimic")
        if mimic is not None:
            (ratio,) = _floats(mimic, "multiplier", 1, "1", f"{where}, <mimic>")
            (offset,) = _floats(mimic, "offset", 1, "0", f"{where}, <mimic>")
            tree.mimic.append((name, mimic.get("joint", ""), ratio, offset))
            joint.remove(mimic)
    return ends["child"]


def _limits(joint: ElementTree.Element, kind: str, where: str) -> None:
    """Leave Pinocchio a joint it cannot misread: an absent range is no range, not [0, 0]."""
    limit = joint.find("limit")
    unbounded = kind == "continuous" or limit is None or ("lower" not in limit.attrib and "upper" not in limit.attrib)
    if kind == "continuous":
        joint.set("type", "revolute")
    if limit is None:
        limit = ElementTree.SubElement(joint, "limit")
    for key, default in (("effort", "0"), ("velocity", "0")):
        _floats(limit, key, 1, default, f"{where}, <limit>")
        limit.set(key, limit.get(key, default))
    if unbounded:
        limit.set("lower", "-1e308")
        limit.set("upper", "1e308")
    else:
        (lower,) = _floats(limit, "lower", 1, "0", f"{where}, <limit>")
        (upper,) = _floats(limit, "upper", 1, "0", f"{where}, <limit>")
        if lower > upper:
            raise MechanismError(f"{where}: its lower limit {lower:g} is above the upper one {upper:g}")


def _check_connected(
    base: str, joints: dict[str, ElementTree.Element], links: dict[str, ElementTree.Element], source: str
) -> None:
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
