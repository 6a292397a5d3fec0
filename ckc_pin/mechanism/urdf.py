"""URDF files, from strangers, to one Pinocchio model.

XML is parsed strictly by expat, document types (and with them entities) are refused, and what
Pinocchio would accept in silence is checked here: negative or NaN masses, zero axes, duplicate names,
unknown parents, two roots, two inertials of a link. `continuous` joints are loaded as revolute ones without limits,
so that every joint is one number (Pinocchio would use a cosine and a sine); a `planar` joint is refused since
Pinocchio ignores its axis. An inertial without one of its numbers is refused too: urdfdom, which reads for
Pinocchio, drops it with a line on stderr and the link has no mass. Several trees become one URDF under a
common root, stripped to what dynamics need, before Pinocchio sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree

from ckc_pin.base.xml import strict_xml
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.urdf_checks import (
    Mimic,
    by_name,
    check_connected,
    check_inertial,
    check_joint,
    check_single_elements,
)

__all__ = ["WORLD", "TreeText", "UrdfTree", "merge", "parse"]

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
    root = strict_xml(text, source)
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
