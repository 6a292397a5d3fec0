"""MuJoCo's equality constraints to loops and couplings; anchors and relative poses are as its compiler has them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.formats.draft import frame, number, unique, vector
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.tendons import Tendon, Tendons
from ckc_pin.formats.mjcf.tree import MjcfTree, Placed
from ckc_pin.formats.orientation import from_quaternion
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
    compiled : Compiled
    tree : MjcfTree
    tendons : Tendons

    Attributes
    ----------
    loops, couplings : list of (spec, comment)
    left_out : list of str
    """

    def __init__(self, compiled: Compiled, tree: MjcfTree, tendons: Tendons) -> None:
        self.compiled, self.tree, self.tendons = compiled, tree, tendons
        self.loops: list[tuple[LoopSpec, str]] = []
        self.couplings: list[tuple[CouplingSpec, str]] = []
        self.left_out: list[str] = []
        model, kinds = compiled.model, compiled.mujoco.mjtEq
        named = {int(kinds.mjEQ_CONNECT): "connect", int(kinds.mjEQ_WELD): "weld", int(kinds.mjEQ_JOINT): "joint"}
        closures: list[_Closure] = []
        for k in range(model.neq):
            kind = named.get(int(model.eq_type[k]), "tendon")
            name = compiled.name("eq", k)
            if not model.eq_active0[k]:
                self.left_out.append(f"<{kind}> {name}, which is not active".replace("  ", " "))
            elif kind in ("connect", "weld"):
                closures.append(self._closure(k, kind, name))
            elif kind == "joint":
                self._coupling(k)
            else:
                self._length(k, name)
        for pair in self._by_pair(closures):
            self._add_loops(pair)

    def _closure(self, k: int, kind: str, name: str) -> _Closure:
        """Place the two frames that a connect or a weld brings together."""
        model, data = self.compiled.model, self.compiled.model.eq_data[k]
        ends = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
        if int(model.eq_objtype[k]) == self.compiled.mujoco.mjtObj.mjOBJ_SITE:
            first, second = (self.tree.site(end) for end in ends)
            called = [self.compiled.name("site", end) for end in ends]
            comment = f"{kind} of sites {called[0]} and {called[1]}"
        else:
            one, two = (self.tree.bodies[max(end, 0)] for end in ends)
            called = [self.compiled.bodies[max(end, 0)] for end in ends]
            comment = f"{kind} of bodies {called[0]} and {called[1]}"
            if kind == "connect":
                first, second = one.at(_shift(data[0:3])), two.at(_shift(data[3:6]))
                comment += ", its second point from the reference pose"
            else:
                first, second = (
                    one.at(pin.SE3(from_quaternion(data[6:10]), data[3:6].copy())),
                    two.at(_shift(data[0:3])),
                )
        soft = kind == "weld" and data[10] == 0
        meant = "point" if kind == "connect" or soft else "weld"
        return _Closure(name or f"{called[0]}_{called[1]}", meant, first, second, comment)

    def _coupling(self, k: int) -> None:
        """Read joint1 - ref1 = c0 + c1 (joint2 - ref2) + higher powers."""
        model, names = self.compiled.model, self.compiled.joints
        joint, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        polynomial = [float(x) for x in model.eq_data[k, :5]]
        if any(j >= 0 and j not in self.tree.ref for j in (joint, other)):
            self.left_out.append(f"equality of joint {names[joint]}, which has more than one freedom or is part of one")
        elif other < 0:
            self._hold(joint, self.tree.ref[joint] + polynomial[0])
        elif any(polynomial[2:]):
            self.left_out.append(
                f"equality of joints {names[joint]} and {names[other]}: its polynomial {polynomial} is not linear; "
                "a [[coupling]] at one angle may stand in"
            )
        else:
            ratio = polynomial[1]
            offset = self.tree.ref[joint] + polynomial[0] - ratio * self.tree.ref[other]
            self._couple(joint, other, ratio, offset, "joint equality")

    def _hold(self, joint: int, value: float) -> None:
        """Hold a joint at a value, with a coupling to any other."""
        names = self.compiled.joints
        other = next((j for j in self.tree.ref if j != joint), None)
        if other is None:
            self.left_out.append(f"joint {names[joint]} is held at {value:g}, and there is no other joint: fix it")
            return
        said = f"holds {names[joint]} at a value; a ratio of 0 makes {names[other]} count for nothing"
        self._couple(joint, other, 0.0, value, said)

    def _couple(self, joint: int, other: int, ratio: float, offset: float, comment: str) -> None:
        names = self.compiled.joints
        spec = CouplingSpec(joint=names[joint], other=names[other], ratio=number(ratio), offset=number(offset))
        self.couplings.append((spec, comment))

    def _length(self, k: int, name: str) -> None:
        """Read a tendon kept at its length: between two sites a distance, over two joints a coupling."""
        model = self.compiled.model
        tendon = self.tendons.all[int(model.eq_obj1id[k])]
        kept = not model.eq_data[k, 1:5].any() or model.eq_obj2id[k] < 0
        length = float(model.tendon_length0[tendon.number] + model.eq_data[k, 0])
        called = name or tendon.name
        if kept and tendon.ends is not None and length > 0:
            ends = [_point(self.tree.site(site)) for site in tendon.ends]
            spec = LoopSpec(
                name=unique(called, [spec.name for spec, _ in self.loops]),
                type="distance",
                frame_a=ends[0],
                frame_b=ends[1],
                length=number(length),
            )
            self.loops.append((spec, f"tendon {tendon.name}, kept at its length".replace("  ", " ")))
        elif kept and self._is_gear(tendon):
            (joint, of_joint), (other, of_other) = tendon.joints
            offset = length / of_joint
            self._couple(joint, other, -of_other / of_joint, offset, f"tendon {tendon.name}, kept at its length")
        else:
            self.left_out.append(f"equality <tendon> {called}".rstrip())

    def _is_gear(self, tendon: Tendon) -> bool:
        joints = tendon.joints
        return len(joints) == 2 and joints[0][1] != 0 and all(joint in self.tree.ref for joint, _ in joints)

    def _by_pair(self, closures: list[_Closure]) -> Iterator[list[_Closure]]:
        """Group what closes the same two links, in the order of the file."""
        order: dict[frozenset[str], int] = {}
        for closure in closures:
            order.setdefault(frozenset((closure.a.link, closure.b.link)), len(order))

        def key(closure: _Closure) -> int:
            return order[frozenset((closure.a.link, closure.b.link))]

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


def _shift(translation: Array) -> pin.SE3:
    return pin.SE3(np.eye(3), translation.copy())


def _point(placed: Placed) -> Frame:
    """Return a frame at a point, along the link's axes."""
    return frame(placed.link, _shift(placed.pose.translation))
