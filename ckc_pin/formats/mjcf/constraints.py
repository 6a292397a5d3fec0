"""Convert MuJoCo's equality constraints and tendons to loops, couplings and springs.

Anchors and relative poses are those that MuJoCo's compiler computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial

from ckc_pin.base.arrays import Array
from ckc_pin.formats.conversion import from_quaternion, make_frame, make_unique, round_number, round_vector
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.tree import MjcfTree, Placed
from ckc_pin.mechanism.spec import CouplingSpec, Frame, LoopSpec, SpringSpec

__all__ = ["Equalities", "Tendons"]

# A fixed tendon whose limits are closer together ties its joints, rad or m.
MAX_TIED_RANGE = 0.01
# Two connects between the same bodies are a hinge if their distance is equal on both bodies, up to a file's digits.
DISTANCE_TOLERANCE = 1e-4  # relative


# --- tendons -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Tendon:
    """A tendon's path.

    Attributes
    ----------
    number : int
        MuJoCo's.
    name : str
    ends : (int, int) tuple or None
        Sites at the ends of a straight line; None for any other path.
    joints : list of (int, float)
        Joints of a fixed tendon with their coefficients.
    """

    number: int
    name: str
    ends: tuple[int, int] | None
    joints: list[tuple[int, float]]


class Tendons:
    """The tendons of a compiled model.

    A straight line between two sites with stiffness or damping is a spring. A fixed tendon with limits close together
    is a coupling (`Equalities`). Other tendons that act are left out.

    Attributes
    ----------
    tendons : list of _Tendon
        By MuJoCo's number.
    """

    def __init__(self, compiled: Compiled) -> None:
        self.compiled = compiled
        self.tendons = [self._read(k) for k in range(compiled.model.ntendon)]

    @property
    def used_joints(self) -> set[int]:
        """Joints of fixed tendons."""
        return {joint for tendon in self.tendons for joint, _ in tendon.joints}

    def tied_length(self, tendon: _Tendon) -> float | None:
        """Return the middle of a fixed tendon's limits if they are so close together that they tie its joints."""
        lower, upper = (float(x) for x in self.compiled.model.tendon_range[tendon.number])
        is_limited = tendon.joints and self.compiled.model.tendon_limited[tendon.number]
        return (lower + upper) / 2 if is_limited and 0 <= upper - lower < MAX_TIED_RANGE else None

    def springs(self, tree: MjcfTree) -> tuple[list[tuple[SpringSpec, str]], list[str]]:
        """Return the springs between frames with comments, and notes on properties that are left out."""
        model, springs, left_out = self.compiled.model, [], []
        for tendon in self.tendons:
            k = tendon.number
            shortest, longest = (float(x) for x in model.tendon_lengthspring[k])
            stiffness, damping = float(model.tendon_stiffness[k]), float(model.tendon_damping[k])
            unsupported = {
                "a limit": model.tendon_limited[k] and self.tied_length(tendon) is None,
                "dry friction": model.tendon_frictionloss[k],
                "armature": model.tendon_armature[k],
                "stiffness or damping of higher order": np.any(model.tendon_stiffnesspoly[k])
                or np.any(model.tendon_dampingpoly[k]),
            }
            has_force = bool(stiffness or damping)
            if has_force and (tendon.ends is None or (stiffness and shortest != longest)):
                unsupported["stiffness or damping"] = True
            elif has_force and tendon.ends is not None:
                ends = [_point(tree.site(site)) for site in tendon.ends]
                spec = SpringSpec(
                    frame_a=ends[0],
                    frame_b=ends[1],
                    rest_length=round_number(longest) if stiffness else 0.0,
                    stiffness=stiffness,
                    damping=damping,
                )
                springs.append((spec, f"tendon {tendon.name}".rstrip()))
            properties = [name for name, value in unsupported.items() if value]
            if properties:
                left_out.append(f"{' and '.join(properties)} of tendon {tendon.name or k}")
        return springs, left_out

    def _read(self, k: int) -> _Tendon:
        model, wraps = self.compiled.model, self.compiled.mujoco.mjtWrap
        first = int(model.tendon_adr[k])
        path = [(int(model.wrap_type[w]), w) for w in range(first, first + int(model.tendon_num[k]))]
        sites = [int(model.wrap_objid[w]) for kind, w in path if kind == wraps.mjWRAP_SITE]
        joints = [
            (int(model.wrap_objid[w]), float(model.wrap_prm[w])) for kind, w in path if kind == wraps.mjWRAP_JOINT
        ]
        ends = (sites[0], sites[1]) if len(path) == len(sites) == 2 else None
        return _Tendon(k, self.compiled.name("tendon", k), ends, joints)


# --- equality constraints ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Closure:
    """Two frames that a connect ("point") or a weld ("weld") brings together."""

    name: str
    kind: str
    a: Placed
    b: Placed
    comment: str


class Equalities:
    """Loops and couplings of a compiled model.

    Parameters
    ----------
    compiled : Compiled
    tree : MjcfTree
    tendons : Tendons

    Attributes
    ----------
    loops, couplings : list of (spec, comment)
    guessed, left_out : list of str
    """

    def __init__(self, compiled: Compiled, tree: MjcfTree, tendons: Tendons) -> None:
        self.compiled, self.tree, self.tendons = compiled, tree, tendons
        self.loops: list[tuple[LoopSpec, str]] = []
        self.couplings: list[tuple[CouplingSpec, str]] = []
        self.guessed: list[str] = []
        self.left_out: list[str] = []
        model, kinds = compiled.model, compiled.mujoco.mjtEq
        tags = {int(kinds.mjEQ_CONNECT): "connect", int(kinds.mjEQ_WELD): "weld", int(kinds.mjEQ_JOINT): "joint"}
        closures: list[_Closure] = []
        for k in range(model.neq):
            tag = tags.get(int(model.eq_type[k]), "tendon")
            name = compiled.name("eq", k)
            if not model.eq_active0[k]:
                self.left_out.append(f"<{tag}> {name}, which is not active".replace("  ", " "))
            elif tag in ("connect", "weld"):
                closures.append(self._read_closure(k, tag, name))
            elif tag == "joint":
                self._add_joint_equality(k)
            else:
                self._add_tendon_equality(k, name)
        for tendon in tendons.tendons:
            self._add_tight_limit(tendon)
        for group in _group_by_links(closures):
            self._add_loops(group)

    def _read_closure(self, k: int, tag: str, name: str) -> _Closure:
        """Return the two frames of a connect or a weld."""
        model, data = self.compiled.model, self.compiled.model.eq_data[k]
        ids = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
        if int(model.eq_objtype[k]) == self.compiled.mujoco.mjtObj.mjOBJ_SITE:
            a, b = (self.tree.site(site) for site in ids)
            names = [self.compiled.name("site", site) for site in ids]
            comment = f"{tag} of sites {names[0]} and {names[1]}"
        else:
            body_a, body_b = (self.tree.bodies[max(body, 0)] for body in ids)
            names = [self.compiled.bodies[max(body, 0)] for body in ids]
            comment = f"{tag} of bodies {names[0]} and {names[1]}"
            if tag == "connect":
                a, b = body_a.at(_shift(data[0:3])), body_b.at(_shift(data[3:6]))
                comment += "; its second point is computed from the reference pose"
            else:
                a = body_a.at(pin.SE3(from_quaternion(data[6:10]), data[3:6].copy()))
                b = body_b.at(_shift(data[0:3]))
        only_translation = tag == "connect" or data[10] == 0  # a weld with torquescale = 0 leaves rotations free
        return _Closure(name or f"{names[0]}_{names[1]}", "point" if only_translation else "weld", a, b, comment)

    def _add_joint_equality(self, k: int) -> None:
        """Add joint1 - ref1 = p(joint2 - ref2), p a polynomial, as a coupling."""
        model, names = self.compiled.model, self.compiled.joints
        joint, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        powers = [float(x) for x in model.eq_data[k, :5]]
        if any(j >= 0 and j not in self.tree.ref for j in (joint, other)):
            self.left_out.append(f"equality of joint {names[joint]}, which is not a hinge or slide of its own")
        elif other < 0:
            value = self.tree.ref[joint] + powers[0]
            spec = CouplingSpec(joints={names[joint]: 1.0}, offset=round_number(value))
            self.couplings.append((spec, f"fixes {names[joint]} at a value"))
        elif any(powers[2:]):
            shifted = Polynomial(powers)(Polynomial([-self.tree.ref[other], 1.0])) + self.tree.ref[joint]
            coefficients = [round_number(float(x)) for x in shifted.trim().coef]
            spec = CouplingSpec(joint=names[joint], other=names[other], polynomial=coefficients)
            self.couplings.append((spec, "joint equality"))
        else:
            ratio = powers[1]
            offset = self.tree.ref[joint] + powers[0] - ratio * self.tree.ref[other]
            self._add_gear(joint, other, ratio, offset, "joint equality")

    def _add_gear(self, joint: int, other: int, ratio: float, offset: float, comment: str) -> None:
        names = self.compiled.joints
        spec = CouplingSpec(
            joint=names[joint], other=names[other], ratio=round_number(ratio), offset=round_number(offset)
        )
        self.couplings.append((spec, comment))

    def _add_sum(self, joints: list[tuple[int, float]], length: float, name: str, comment: str) -> None:
        """Add a coupling that holds a sum of coefficient * joint at a length."""
        if len(joints) == 2:
            (joint, coefficient), (other, other_coefficient) = joints
            self._add_gear(joint, other, -other_coefficient / coefficient, length / coefficient, comment)
            return
        coefficients = {self.compiled.joints[joint]: round_number(x) for joint, x in joints}
        unique = make_unique(name or "sum", [spec.name or "" for spec, _ in self.couplings])
        self.couplings.append((CouplingSpec(name=unique, joints=coefficients, offset=round_number(length)), comment))

    def _add_tight_limit(self, tendon: _Tendon) -> None:
        """Add a tendon whose limits are close together as a coupling at their middle."""
        length, joints = self.tendons.tied_length(tendon), self._tied_joints(tendon)
        if length is None:
            return
        label = f"tendon {tendon.name or tendon.number}"
        if joints is None:
            self.left_out.append(f"a limit of {label}")
            return
        comment = f"{label}, whose limits are closer together than {MAX_TIED_RANGE:g}"
        self._add_sum(joints, length, tendon.name, comment)
        self.guessed.append(f"the limits of {label} are so close that it is a coupling at their middle, {length:g}")

    def _add_tendon_equality(self, k: int, name: str) -> None:
        """Add a tendon of constant length: a distance between two sites, or a coupling of its joints."""
        model = self.compiled.model
        tendon = self.tendons.tendons[int(model.eq_obj1id[k])]
        is_constant = not model.eq_data[k, 1:5].any() or model.eq_obj2id[k] < 0
        length = float(model.tendon_length0[tendon.number] + model.eq_data[k, 0])
        label = name or tendon.name
        comment = f"tendon {tendon.name} of constant length".replace("  ", " ")
        if is_constant and tendon.ends is not None and length > 0:
            ends = [_point(self.tree.site(site)) for site in tendon.ends]
            spec = LoopSpec(
                name=make_unique(label, [spec.name for spec, _ in self.loops]),
                type="distance",
                frame_a=ends[0],
                frame_b=ends[1],
                length=round_number(length),
            )
            self.loops.append((spec, comment))
        elif is_constant and (joints := self._tied_joints(tendon)) is not None:
            self._add_sum(joints, length, tendon.name, comment)
        else:
            self.left_out.append(f"equality <tendon> {label}".rstrip())

    def _tied_joints(self, tendon: _Tendon) -> list[tuple[int, float]] | None:
        """Return the joints of a fixed tendon with coefficients; None if one has several freedoms or there are none."""
        joints = [(joint, coefficient) for joint, coefficient in tendon.joints if coefficient != 0]
        return joints if joints and all(joint in self.tree.ref for joint, _ in joints) else None

    def _add_loops(self, group: list[_Closure]) -> None:
        """Add the loops between two links. Two points at the same distance on both links are a hinge."""
        names = [spec.name for spec, _ in self.loops]
        if [c.kind for c in group] == ["point", "point"]:
            first, second = group
            if first.a.link != second.a.link:
                second = _Closure(second.name, second.kind, second.b, second.a, second.comment)
            axis_a, axis_b = (
                to.pose.translation - start.pose.translation for start, to in ((first.a, second.a), (first.b, second.b))
            )
            distance = float(np.linalg.norm(axis_a))
            if distance > 0 and abs(np.linalg.norm(axis_b) - distance) <= DISTANCE_TOLERANCE * distance:
                spec = LoopSpec(
                    name=make_unique(first.name, names),
                    type="hinge",
                    frame_a=_point(first.a),
                    frame_b=_point(first.b),
                    axis_a=round_vector(axis_a / distance),
                    axis_b=round_vector(axis_b / np.linalg.norm(axis_b)),
                )
                comment = f"two connects {1e3 * distance:g} mm apart: {first.comment}; {second.comment}"
                self.loops.append((spec, comment))
                return
        for closure in group:
            name = make_unique(closure.name, [spec.name for spec, _ in self.loops])
            if closure.kind == "weld":
                ends = [make_frame(end.link, end.pose) for end in (closure.a, closure.b)]
                spec = LoopSpec(name=name, type="weld", frame_a=ends[0], frame_b=ends[1])
            else:
                ends = [_point(end) for end in (closure.a, closure.b)]
                spec = LoopSpec(name=name, type="point", frame_a=ends[0], frame_b=ends[1])
            self.loops.append((spec, closure.comment))


def _group_by_links(closures: list[_Closure]) -> Iterator[list[_Closure]]:
    """Yield the closures between the same two links, groups in the order of the file."""
    order: dict[frozenset[str], int] = {}
    for closure in closures:
        order.setdefault(frozenset((closure.a.link, closure.b.link)), len(order))

    def key(closure: _Closure) -> int:
        return order[frozenset((closure.a.link, closure.b.link))]

    for _, group in groupby(sorted(closures, key=key), key):
        yield list(group)


def _shift(translation: Array) -> pin.SE3:
    return pin.SE3(np.eye(3), translation.copy())


def _point(placed: Placed) -> Frame:
    """Return a frame at a point, with the link's axes."""
    return make_frame(placed.link, _shift(placed.pose.translation))
