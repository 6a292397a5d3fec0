"""MuJoCo's equality constraints to loops and couplings, through the reference pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import frame, number, unique, vector
from ckc_pin.formats.mjcf.document import Attributes, Document
from ckc_pin.formats.mjcf.tree import MjcfTree, Placed
from ckc_pin.mechanism.spec import CouplingSpec, Frame, LoopSpec

__all__ = ["Equalities"]

SAME = 1e-4  # of the distance between two anchors: equal on both bodies to the digits of a file, they are one hinge


@dataclass(frozen=True)
class _Closure:
    """A connect or a weld: what must coincide."""

    name: str
    kind: str
    a: Placed
    b: Placed
    comment: str


class Equalities:
    """Loops and couplings of a model.

    Parameters
    ----------
    document : Document
    tree : MjcfTree
        With every body, site and joint.

    Attributes
    ----------
    loops, couplings : list of (spec, comment)
    left_out, guessed : list of str
    """

    def __init__(self, document: Document, tree: MjcfTree) -> None:
        self.document = document
        self.tree = tree
        self.loops: list[tuple[LoopSpec, str]] = []
        self.couplings: list[tuple[CouplingSpec, str]] = []
        self.left_out: list[str] = []
        self.guessed: list[str] = []
        closures: list[_Closure] = []
        for element in (e for section in document.root.findall("equality") for e in section):
            a = document.attributes(element)
            name = element.get("name", "")
            if document.attributes(element).flag("active", "true") == "false":
                self.left_out.append(f"<{element.tag}> {name}, which is not active".replace("  ", " "))
            elif element.tag in ("connect", "weld"):
                closures.append(self._closure(element, a))
            elif element.tag == "joint":
                self._coupling(a)
            else:
                self.left_out.append(f"equality <{element.tag}> {name}".rstrip())
        for pair in self._by_pair(closures):
            self._add_loops(pair)

    def _closure(self, element: Element, a: Attributes) -> _Closure:
        """Place the two frames that a connect or a weld brings together."""
        if "site1" in a and "site2" in a:
            first, second = (self._find(self.tree.sites, a, key, "site") for key in ("site1", "site2"))
            comment = f"{element.tag} of sites {a.get('site1')} and {a.get('site2')}"
            ends = (a.get("site1"), a.get("site2"))
        elif "body1" in a:
            one = self._find(self.tree.bodies, a, "body1", "body")
            two = self._find(self.tree.bodies, a, "body2", "body") if a.get("body2") else self.tree.bodies["world"]
            first, second, said = self._bodies(element.tag, a, one, two)
            ends = (a.get("body1"), a.get("body2", "world"))
            comment = f"{element.tag} of bodies {ends[0]} and {ends[1]}{said}"
        else:
            raise InputError(f"{a.where}: needs body1, or site1 and site2")
        soft = element.tag == "weld" and a.number("torquescale", 1.0) == 0
        kind = "point" if element.tag == "connect" or soft else "weld"
        return _Closure(element.get("name") or f"{ends[0]}_{ends[1]}", kind, first, second, comment)

    def _bodies(self, tag: str, a: Attributes, one: Placed, two: Placed) -> tuple[Placed, Placed, str]:
        """Frames on two bodies; what the file does not say is what it is in the reference pose."""
        if tag == "connect":
            first = one.at(pin.SE3(np.eye(3), np.array(a.numbers("anchor", "", 3)[:3])))
            there = pin.SE3(np.eye(3), two.reference.actInv(first.reference.translation))
            return first, two.at(there), ", its second point from the reference pose"
        anchor = two.at(pin.SE3(np.eye(3), a.point("anchor")))
        *xyz, w, x, y, z = a.numbers("relpose", "0 1 0 0 0 0 0", 7)[:7]
        if any((w, x, y, z)):
            turn = pin.Quaternion(np.array([x, y, z, w])).normalized().matrix()
            return one.at(pin.SE3(turn, np.array(xyz))), anchor, ""
        return one.at(one.reference.actInv(anchor.reference)), anchor, ", as they are in the reference pose"

    def _coupling(self, a: Attributes) -> None:
        """Read joint1 - ref1 = c0 + c1 (joint2 - ref2) + higher powers."""
        joint = self._joint(a, "joint1")
        polynomial = (a.numbers("polycoef", "0 1 0 0 0") + [0.0] * 5)[:5] if "polycoef" in a else [0, 1, 0, 0, 0]
        other = self._joint(a, "joint2") if a.get("joint2") else None
        if other is not None and any(polynomial[2:]):
            self.left_out.append(
                f"equality of joints {joint} and {other}: its polynomial {polynomial} is not linear; "
                "a [[coupling]] at one angle may stand in"
            )
            return
        if other is None:
            value = self.tree.ref[joint] + polynomial[0]
            other = next((name for name in self.tree.ref if name != joint), None)
            if other is None:
                self.left_out.append(f"joint {joint} is held at {value:g}, and there is no other joint: make it fixed")
                return
            spec = CouplingSpec(joint=joint, other=other, ratio=0.0, offset=number(value))
            self.couplings.append((spec, f"holds {joint} at a value; a ratio of 0 makes {other} count for nothing"))
            return
        ratio = polynomial[1]
        offset = self.tree.ref[joint] + polynomial[0] - ratio * self.tree.ref[other]
        spec = CouplingSpec(joint=joint, other=other, ratio=number(ratio), offset=number(offset))
        self.couplings.append((spec, "joint equality"))

    def _by_pair(self, closures: list[_Closure]) -> Iterator[list[_Closure]]:
        """Group what closes the same two links, in the order of the file."""
        order: dict[frozenset[str], int] = {}
        for closure in closures:
            order.setdefault(frozenset((closure.a.link, closure.b.link)), len(order))
        key = lambda c: order[frozenset((c.a.link, c.b.link))]  # noqa: E731
        for _, group in groupby(sorted(closures, key=key), key):
            yield list(group)

    def _add_loops(self, pair: list[_Closure]) -> None:
        """Add what closes two links: two points at one distance on both are a hinge."""
        taken = [spec.name for spec, _ in self.loops]
        if [c.kind for c in pair] == ["point", "point"]:
            first, second = pair
            if first.a.link != second.a.link:
                second = _Closure(second.name, second.kind, second.b, second.a, second.comment)
            along_a, along_b = (
                there.pose.translation - here.pose.translation
                for here, there in ((first.a, second.a), (first.b, second.b))
            )
            apart = float(np.linalg.norm(along_a))
            if apart > 0 and abs(np.linalg.norm(along_b) - apart) <= SAME * apart:
                spec = LoopSpec(
                    name=unique(first.name, taken),
                    type="hinge",
                    frame_a=_point(first.a),
                    frame_b=_point(first.b),
                    axis_a=vector(along_a / apart),
                    axis_b=vector(along_b / np.linalg.norm(along_b)),
                )
                self.loops.append((spec, f"two connects {1e3 * apart:g} mm apart: {first.comment}; {second.comment}"))
                return
        for closure in pair:
            name = unique(closure.name, [spec.name for spec, _ in self.loops])
            if closure.kind == "weld":
                ends = [frame(end.link, end.pose) for end in (closure.a, closure.b)]
                spec = LoopSpec(name=name, type="weld", frame_a=ends[0], frame_b=ends[1])
            else:
                ends = [_point(end) for end in (closure.a, closure.b)]
                spec = LoopSpec(name=name, type="point", frame_a=ends[0], frame_b=ends[1])
            self.loops.append((spec, closure.comment))

    def _find(self, known: dict[str, Placed], a: Attributes, key: str, what: str) -> Placed:
        if a.get(key) not in known:
            raise InputError(f"{a.where}: {key}: no {what} {a.get(key)!r}; there are {', '.join(known) or 'none'}")
        return known[a.get(key)]

    def _joint(self, a: Attributes, key: str) -> str:
        if a.get(key) not in self.tree.ref:
            known = ", ".join(self.tree.ref) or "none"
            raise InputError(f"{a.where}: {key}: no hinge or slide {a.get(key)!r}; there are {known}")
        return a.get(key)


def _point(placed: Placed) -> Frame:
    """Return a frame at a point, along the link's axes."""
    return frame(placed.link, pin.SE3(np.eye(3), placed.pose.translation))
