"""What other values of named numbers make of a mechanism's, for many members at once.

The names are those of `mechanism.parameters`; the numbers those of `generated.arguments`, which the native core and
the code that is written out take. Building a mechanism anew for each value does the same, and says why one cannot be;
this does it in arrays, a row a member, and only says which members are to be built that way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.arguments import numbers, present, values
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES, values_of
from ckc_pin.mechanism.spec import FrameSpec
from ckc_pin.mechanism.urdf import INERTIA

__all__ = ["Varied"]

CLOSE = 1e-12  # of the largest number of a kind: how near the mechanism's own numbers have to come out
AT = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
NOT_NEGATIVE = ("stiffness", "damping", "rest_length")
OF_SPRING = ("stiffness", "damping", "rest_length", "rest")


class Varied:
    """Named numbers of a mechanism as a function of their values.

    Parameters
    ----------
    mechanism : Mechanism
    names : sequence of str
        Names that vary; known ones.

    Attributes
    ----------
    possible : bool
        Whether all of them are taken here; if not, members are built one by one.
    which : dict of str to bool arrays
        Which of the mechanism's numbers are not zero for some value.
    """

    def __init__(self, mechanism: Mechanism, names: Sequence[str]) -> None:
        self.mechanism, self.names = mechanism, tuple(names)
        self._own = numbers(mechanism)
        self._present = values_of(mechanism.spec, mechanism.urdf)
        self.which = present(self._own)
        self.possible = mechanism.tree.is_euclidean and all(_is_taken(name) for name in self.names)
        if self.possible and self.names:
            self.possible = self._reproduces()
        if self.possible and self.names:
            trial = np.random.default_rng(0).uniform(0.5, 1.0, (2, len(self.names)))
            for name, found in self.of(trial)[0].items():
                self.which[name] = self.which[name] | present({name: found[0]})[name]

    def of(self, given: Array) -> tuple[dict[str, Array], BoolArray]:
        """Return the numbers that differ between members.

        Parameters
        ----------
        given : (members, names) array

        Returns
        -------
        dict of str to (members, ...) array
            By the names and shapes of `generated.arguments.numbers`; what does not vary is left out.
        (members,) array of bool
            Which members can be: physical as far as is seen here.
        """
        sound = np.all(np.isfinite(given), axis=1)
        now: dict[str, Array] = {}
        for k, name in enumerate(self.names):
            self._put(now, name, given[:, k])
        found: dict[str, Array] = {}
        if "gravity" in now:
            found["gravity"] = now["gravity"]
        self._of_tables(now, found, sound)
        if any(name.partition(".")[0] in ("link", "joint", "loop", "spring") for name in now):
            with np.errstate(all="ignore"):  # of members that cannot be: no mass, or one that is not finite
                _Geometry(self.mechanism, self._present, now, found, sound, self._own).add(len(given))
        return found, sound

    def arguments(self, found: Mapping[str, Array], members: int) -> Array:
        """Return what the written-out code takes, (members, arguments), from what `of` found."""
        parts = []
        for name, own in self._own.items():
            there = self.which[name]
            part = found[name] if name in found else np.broadcast_to(own, (members, *own.shape))
            parts.append(part[:, there])
        return np.ascontiguousarray(np.concatenate(parts, axis=1))

    def _reproduces(self) -> bool:
        """Whether the mechanism's own values give its own numbers: nothing in it that is not known here."""
        own = np.array([[self._value(name) for name in self.names]])
        for name, found in self.of(own)[0].items():
            if not np.allclose(
                found[0], self._own[name], rtol=0, atol=CLOSE * np.abs(self._own[name]).max(initial=1e-3)
            ):
                return False
        return bool(np.array_equal(values(self._own, self.which), self.arguments({}, 1)[0]))

    def _value(self, name: str) -> float:
        if name in self._present:
            value = self._present[name]
            assert not isinstance(value, tuple)
            return value
        of, _, axis = name.rpartition(".")
        vector = self._present[of]
        assert isinstance(vector, tuple)
        return vector[AXES.index(axis)]

    def _put(self, now: dict[str, Array], name: str, column: Array) -> None:
        """Enter a name's values; a component's into the vector that it is of, (members, 3)."""
        if name in self._present:
            now[name] = column
            return
        of, _, axis = name.rpartition(".")
        if of not in now:
            now[of] = np.tile(np.array(self._present[of], dtype=float), (len(column), 1))
        now[of][:, AXES.index(axis)] = column

    def _of_tables(self, now: Mapping[str, Array], found: dict[str, Array], sound: BoolArray) -> None:
        """Numbers of loops, springs, couplings, forces and joints, which are where they are."""
        spec, tree = self.mechanism.spec, self.mechanism.tree
        rows = [".".join(row) for row in self.mechanism.closure.names]
        lines = [k for k, spring in enumerate(spec.spring) if spring.joint is None]
        for name, column in now.items():
            root, _, rest = name.partition(".")
            if column.ndim > 1 or root in ("gravity", "link"):
                continue
            carrier, _, key = rest.rpartition(".")
            if root == "loop":
                sound &= column > 0
                self._set(found, "length", rows.index(f"{carrier}.length"), column)
            elif root == "force":
                at = tree.index[spec.force[int(carrier)].joint]
                self._add(found, "constant", at, column - spec.force[int(carrier)].value)
            elif root == "joint":
                sound &= column >= 0
                own = self._value(name)
                self._add(found, "joint_damping", tree.index[carrier], column - own)
            elif root == "spring":
                if key in NOT_NEGATIVE:
                    sound &= column >= 0
                spring = spec.spring[int(carrier)]
                if spring.joint is None:
                    self._set(found, key, lines.index(int(carrier)), column)
                elif key == "damping":
                    self._add(found, "joint_damping", tree.index[spring.joint], column - spring.damping)
                else:
                    self._set(found, f"joint_{key}", tree.index[spring.joint], column)

    def _set(self, found: dict[str, Array], name: str, at: int, column: Array) -> None:
        self._of(found, name, len(column))[:, at] = column

    def _add(self, found: dict[str, Array], name: str, at: int, column: Array) -> None:
        self._of(found, name, len(column))[:, at] += column

    def _of(self, found: dict[str, Array], name: str, members: int) -> Array:
        if name not in found:
            found[name] = np.tile(self._own[name], (members, *([1] * self._own[name].ndim)))
        return found[name]


def _is_taken(name: str) -> bool:
    root, _, rest = name.partition(".")
    key = rest.rpartition(".")[2]
    whole = rest.rpartition(".")[0].rpartition(".")[2] if key in AXES else key
    return {
        "gravity": True,
        "link": True,
        "joint": whole in ("xyz", "damping"),
        "loop": whole in ("xyz", "length"),
        "spring": whole in ("xyz", *OF_SPRING),
        "force": True,
    }.get(root, False)


class _Geometry:
    """Bodies and points as they follow from links, joints and frames; what is (members, 3) varies."""

    def __init__(
        self,
        mechanism: Mechanism,
        before: Mapping[str, Any],
        now: Mapping[str, Array],
        found: dict[str, Array],
        sound: BoolArray,
        own: Mapping[str, Array],
    ) -> None:
        self.mechanism, self.before, self.now, self.found, self.sound, self.own = (
            mechanism, before, now, found, sound, own,
        )  # fmt: skip
        self.links: dict[str, tuple[int, Array, Array]] = {}  # body, rotation, place in it
        self.joints: dict[str, tuple[int, Array, Array]] = {}
        self.offset: dict[int, Array] = {}

    def add(self, members: int) -> None:
        """Add placements, bodies and points to what was found."""
        self._place()
        model, closure, springs = self.mechanism.tree.model, self.mechanism.closure, self.mechanism.springs
        self._enter("offset", dict(self.offset), members)
        bodies: dict[str, dict[int, Array]] = {"mass": {}, "centre": {}, "inertia": {}}
        for body in range(1, model.njoints):
            self._body(body, bodies)
        for name, parts in bodies.items():
            self._enter(name, parts, members)
        loops = self.mechanism.spec.loop
        ends = [(f"loop.{x.name}.frame_a", x.frame_a) for x in loops] + [
            (f"loop.{x.name}.frame_b", x.frame_b) for x in loops
        ]
        assert len(ends) == len(closure.anchors.point_local)
        self._enter("point", self._points(ends), members)
        lines = [(k, x) for k, x in enumerate(self.mechanism.spec.spring) if x.joint is None]
        ends = [(f"spring.{k}.frame_a", x.frame_a) for k, x in lines if x.frame_a is not None]
        ends += [(f"spring.{k}.frame_b", x.frame_b) for k, x in lines if x.frame_b is not None]
        assert len(ends) == len(springs.anchors.point_local)
        self._enter("end", self._points(ends), members)

    def _enter(self, name: str, parts: Mapping[int, Array], members: int) -> None:
        """Take what varies of one kind."""
        for at, part in parts.items():
            if part.ndim == self.own[name].ndim - 1:
                continue
            if name not in self.found:
                self.found[name] = np.tile(self.own[name], (members, *([1] * self.own[name].ndim)))
            self.found[name][:, at] = part

    def _value(self, name: str) -> Array:
        return self.now.get(name, np.array(self.before[name], dtype=float))

    def _place(self) -> None:
        """Place all links in the bodies that they are part of, and joints in the bodies that carry them."""
        joints = self.mechanism.urdf.findall("joint")
        children = {_link(joint, "child") for joint in joints}
        for link in self.mechanism.urdf.findall("link"):
            if link.attrib["name"] not in children:
                self.links[link.attrib["name"]] = (0, np.eye(3), np.zeros(3))
        left = list(joints)
        while left:
            joint = next(joint for joint in left if _link(joint, "parent") in self.links)
            left.remove(joint)
            name = joint.attrib["name"]
            body, rotation, place = self.links[_link(joint, "parent")]
            place = place + self._value(f"joint.{name}.xyz") @ rotation.T
            turned = rotation @ _rotation(self.before[f"joint.{name}.rpy"])
            if joint.attrib["type"] != "fixed":
                body = self.mechanism.tree.model.getJointId(name)
                self.offset[body], place, turned = place, np.zeros(3), np.eye(3)
            self.joints[name] = self.links[_link(joint, "child")] = (body, turned, place)

    def _body(self, body: int, bodies: dict[str, dict[int, Array]]) -> None:
        """Put together the links that fixed joints make one body."""
        parts = []
        for link in self.mechanism.urdf.findall("link"):
            name, inertial = link.attrib["name"], link.find("inertial")
            of, rotation, place = self.links[name]
            if of != body or inertial is None:
                continue
            mass = self._value(f"link.{name}.mass")
            centre = place + self._value(f"link.{name}.com") @ rotation.T
            parts.append((mass, centre, rotation @ _of_inertial(inertial), self._tensor(name, mass)))
            if mass.ndim:
                self.sound &= mass > 0
        if not any(x.ndim > least for part in parts for x, least in zip(part, (0, 1, 2, 2), strict=True)):
            return
        total = sum((mass for mass, *_ in parts), np.zeros(()))
        centre = sum((mass[..., None] * c for mass, c, *_ in parts), np.zeros(3)) / total[..., None]
        inertia: Array = np.zeros((3, 3))
        for mass, c, rotation, tensor in parts:
            off = c - centre
            around = np.sum(off**2, axis=-1)[..., None, None] * np.eye(3) - off[..., :, None] * off[..., None, :]
            inertia = inertia + rotation @ tensor @ rotation.T + mass[..., None, None] * around
        bodies["mass"][body], bodies["centre"][body], bodies["inertia"][body] = total, centre, inertia

    def _tensor(self, name: str, mass: Array) -> Array:
        own = np.zeros((3, 3))
        varied = {entry for entry in INERTIA if f"link.{name}.inertia.{entry}" in self.now}
        for entry, (i, j) in AT.items():
            own[i, j] = own[j, i] = self.before[f"link.{name}.inertia.{entry}"]
        before = self.before[f"link.{name}.mass"]
        tensor: Array = own * (mass / before)[..., None, None] if mass.ndim and before > 0 else own
        if varied:
            tensor = np.tile(tensor, (len(self.sound), 1, 1)) if tensor.ndim == 2 else tensor
            for entry in varied:
                i, j = AT[entry]
                tensor[:, i, j] = tensor[:, j, i] = self.now[f"link.{name}.inertia.{entry}"]
            self.sound &= np.linalg.eigvalsh(np.where(np.isfinite(tensor), tensor, 0.0))[:, 0] >= 0
        return tensor

    def _points(self, ends: Sequence[tuple[str, str | FrameSpec]]) -> dict[int, Array]:
        found = {}
        for k, (name, frame) in enumerate(ends):
            link = frame if isinstance(frame, str) else frame.link
            known, key = (self.joints, link[6:]) if link.startswith("joint:") else (self.links, link)
            _, rotation, place = (0, np.eye(3), np.zeros(3)) if link == "world" else known[key]
            found[k] = place + self._value(f"{name}.xyz") @ rotation.T
        return found


def _link(joint: ElementTree.Element, tag: str) -> str:
    return joint.find(tag).attrib["link"]  # type: ignore[union-attr]


def _rotation(rpy: Sequence[float]) -> Array:
    import pinocchio as pin

    return np.asarray(pin.rpy.rpyToMatrix(*rpy))


def _of_inertial(inertial: ElementTree.Element) -> Array:
    origin = inertial.find("origin")
    return _rotation([float(x) for x in ("0 0 0" if origin is None else origin.get("rpy", "0 0 0")).split()])
