"""The closure phi(q') = 0 of eq. 1: every loop type of the design as a table of row primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.frames import Frame, Frames
from ckc_pin.mechanism.pose import Anchors, BodyPose, Pose, Rate
from ckc_pin.mechanism.rows import Affine, Component, Distance, Dot, RelativeLog, Rows
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Closure", "ClosureBuilder", "perpendicular"]

_XYZ = np.eye(3)


@dataclass(frozen=True)
class Closure(Immutable):
    """All rows of all loops and couplings.

    Attributes
    ----------
    anchors : Anchors
    groups : tuple of Rows
        At most one of each primitive.
    names : tuple of (loop, row)
        What each row of phi is, e.g. ("elbow", "x").
    aligned : tuple of (loop, a, b)
        Pairs of directions that must point the same way (a . b > 0) in an assembled hinge.
    turned_by : tuple of (loop, frame)
        What each of the anchors' directions turns with, e.g. ("elbow", "frame_a"); the world's turn with no frame, "".
    """

    anchors: Anchors
    groups: tuple[Rows, ...]
    names: tuple[tuple[str, str], ...]
    aligned: tuple[tuple[str, int, int], ...]
    turned_by: tuple[tuple[str, str], ...] = ()

    @property
    def rows(self) -> int:
        """Number of rows of phi."""
        return len(self.names)

    def phi(self, pose: Pose) -> Array:
        """Residual of the closure, shape (rows,), metres and radians (eq. 27 for the five-bar)."""
        phi = np.empty(len(self.names))
        for group in self.groups:
            phi[group.out] = group.phi(pose)
        return phi

    def jacobian(self, pose: Pose) -> Array:
        """J = d phi / d q', shape (rows, n)."""
        jacobian = np.empty((len(self.names), pose.tree.n))
        for group in self.groups:
            jacobian[group.out] = group.jacobian(pose)
        return jacobian

    def body_jacobian(self, pose: Pose) -> Array:
        """d phi / d (the bodies' own velocities) as `BodyPose` has them, shape (rows, joints, 6).

        Rows of couplings are zero: they hold coordinates, not bodies.
        """
        bodies = BodyPose(pose, self.anchors)
        jacobian = np.zeros((len(self.names), bodies.linear_part.shape[1]))
        for group in self.groups:
            if not isinstance(group, Affine):
                jacobian[group.out] = group.jacobian(bodies)
        return jacobian.reshape(len(self.names), len(pose.translation), 6)

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        """Time derivative of J along a velocity, shape (rows, n)."""
        jacobian_dot = np.empty((len(self.names), pose.tree.n))
        for group in self.groups:
            jacobian_dot[group.out] = group.jacobian_dot(pose, rate)
        return jacobian_dot

    def in_metres(self, tree: Tree) -> Array:
        """Which rows of phi are lengths (the others are angles or cosines), shape (rows,) of bool."""
        metres = np.zeros(len(self.names), dtype=bool)
        for group in self.groups:
            metres[group.out] = group.in_metres(tree)
        return metres

    def only(self, loop: str) -> Closure:
        """Return the closure with the rows of one loop alone, the others replaced by nothing."""
        keep = np.array([k for k, (name, _) in enumerate(self.names) if name == loop], np.intp)
        rows = Selected(self.groups, len(self.names), keep)
        return Closure(self.anchors, (rows,), tuple(self.names[k] for k in keep), ())

    def largest_residuals(self, phi: Array) -> dict[str, float]:
        """Largest |phi| of each loop."""
        worst: dict[str, float] = {}
        for (loop, _), value in zip(self.names, np.abs(phi), strict=True):
            worst[loop] = max(worst.get(loop, 0.0), float(value))
        return worst

    def reversed_hinges(self, pose: Pose) -> list[str]:
        """Loops whose axes point against each other, which their rows alone cannot tell."""
        return [loop for loop, a, b in self.aligned if pose.e[a] @ pose.e[b] <= 0]


@dataclass(frozen=True)
class Selected(Immutable):
    """Some rows of a closure, as a group of its own."""

    groups: tuple[Rows, ...]
    rows: int
    keep: IntArray

    @property
    def out(self) -> IntArray:
        """Places of the rows in phi."""
        return np.arange(len(self.keep))

    def _gather(self, parts: list[Array]) -> Array:
        whole = np.empty((self.rows, *parts[0].shape[1:]))
        for group, part in zip(self.groups, parts, strict=True):
            whole[group.out] = part
        return whole[self.keep]

    def in_metres(self, tree: Tree) -> Array | bool:
        """Whether the rows are lengths."""
        return self._gather([np.broadcast_to(g.in_metres(tree), len(g.out)) for g in self.groups]).astype(bool)

    def phi(self, pose: Pose) -> Array:
        """Residual, shape (rows,)."""
        return self._gather([group.phi(pose) for group in self.groups])

    def jacobian(self, pose: Pose) -> Array:
        """Derivative of phi, shape (rows, n)."""
        return self._gather([group.jacobian(pose) for group in self.groups])

    def jacobian_dot(self, pose: Pose, rate: Rate) -> Array:
        """Time derivative of the Jacobian, shape (rows, n)."""
        return self._gather([group.jacobian_dot(pose, rate) for group in self.groups])


def perpendicular(axis: Array) -> tuple[Array, Array]:
    """Return e1, e2 completing a right-handed (e1, e2, axis); for a coordinate axis the cyclic ones."""
    along = int(np.argmax(np.abs(axis)))
    if axis[along] > 0 and np.count_nonzero(axis) == 1:
        return _XYZ[(along + 1) % 3], _XYZ[(along + 2) % 3]
    e1 = np.cross(axis, _XYZ[int(np.argmin(np.abs(axis)))])
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(axis, e1)


class ClosureBuilder:
    """Collects loops and couplings row by row, then groups the rows by primitive."""

    def __init__(self, tree: Tree, frames: Frames) -> None:
        self.tree = tree
        self.frames = frames
        self.names: list[tuple[str, str]] = []
        self.aligned: list[tuple[str, int, int]] = []
        self._pairs: list[tuple[Frame, Frame]] = []
        self._directions: list[tuple[int, Array]] = []
        self._turned_by: list[tuple[str, str]] = []
        self._components: list[tuple[int, int, int]] = []  # row, pair, direction
        self._dots: list[tuple[int, int, int]] = []  # row, a, b
        self._distances: list[tuple[int, int, float]] = []  # row, pair, length
        self._affine: list[tuple[int, Array, float]] = []  # row, coefficients, offset
        self._logs: list[tuple[list[int], Frame, Frame]] = []

    def pair(self, a: Frame, b: Frame) -> int:
        """Add a pair of points; return its number."""
        self._pairs.append((a, b))
        return len(self._pairs) - 1

    def add_loop(self, loop: LoopSpec) -> None:
        """Add the rows of a loop, in the design's order."""
        where = f"loop {loop.name!r}"
        if loop.name in {name for name, _ in self.names}:
            raise MechanismError(f"{where}: two loops have this name")
        a = self.frames.find(loop.frame_a, f"{where}, frame_a")
        b = self.frames.find(loop.frame_b, f"{where}, frame_b")
        if a.joint == b.joint:
            raise MechanismError(f"{where}: frames A and B move together (the same rigid body); a loop needs two")
        if (loop.length is not None) != (loop.type == "distance"):
            remedy = "needs the key length" if loop.type == "distance" else "has no key length, only 'distance' has"
            raise MechanismError(f"{where}: type {loop.type!r} {remedy}")
        axis_a, axis_b = (_unit(x, f"{where}, {k}") for k, x in (("axis_a", loop.axis_a), ("axis_b", loop.axis_b)))
        e1, e2 = perpendicular(axis_a)
        pair = self.pair(a, b)
        if loop.type in ("point", "hinge", "universal", "weld"):
            self._resolve(loop, pair, a, [("x", _XYZ[0]), ("y", _XYZ[1]), ("z", _XYZ[2])])
        elif loop.type in ("point_2d", "cylindrical", "prismatic"):
            self._resolve(loop, pair, a, [(_label(e1, "e1"), e1), (_label(e2, "e2"), e2)])
        elif loop.length is not None:
            self._distances.append((self._row(loop.name, "length"), pair, loop.length))
        if loop.type in ("hinge", "cylindrical"):
            along_b = self._direction(b, axis_b, loop.name, "frame_b")
            for label, e in (("e1.b", e1), ("e2.b", e2)):
                self._dots.append((self._row(loop.name, label), self._direction(a, e, loop.name, "frame_a"), along_b))
            self.aligned.append((loop.name, self._direction(a, axis_a, loop.name, "frame_a"), along_b))
        elif loop.type == "universal":
            row = self._row(loop.name, "a.b")
            along_a, along_b = (
                self._direction(frame, axis, loop.name, label)
                for frame, axis, label in ((a, axis_a, "frame_a"), (b, axis_b, "frame_b"))
            )
            self._dots.append((row, along_a, along_b))
        elif loop.type in ("prismatic", "weld"):
            self._logs.append(([self._row(loop.name, label) for label in ("rx", "ry", "rz")], a, b))

    def add_coupling(self, coupling: CouplingSpec) -> None:
        """Add the row joint - ratio * other - offset = 0."""
        name = f"{coupling.joint}~{coupling.other}"
        where = f"coupling {name!r}"
        joint, other = (self.tree.joint_index(x, where) for x in (coupling.joint, coupling.other))
        if joint == other:
            raise MechanismError(f"{where}: a joint cannot be coupled to itself")
        coefficients = np.zeros(self.tree.n)
        coefficients[joint], coefficients[other] = 1.0, -coupling.ratio
        self._affine.append((self._row(name, "coupling"), coefficients, coupling.offset))

    def build(self) -> Closure:
        """Group the rows by primitive."""
        groups: list[Rows] = []
        if self._components:
            out, pair, direction = _columns(self._components)
            turning = any(self._directions[k][0] != 0 for k in direction)
            groups.append(Component(out, pair, direction, turning))
        if self._dots:
            groups.append(Dot(*_columns(self._dots)))
        if self._distances:
            out, pair = _columns([(row, k) for row, k, _ in self._distances])
            groups.append(Distance(out, pair, np.array([length for *_, length in self._distances])))
        if self._affine:
            rows, coefficients, offsets = zip(*self._affine, strict=True)
            groups.append(Affine(np.array(rows, np.intp), np.array(coefficients), np.array(offsets)))
        if self._logs:
            out = np.array([row for rows, *_ in self._logs for row in rows], np.intp)
            a, b = [x for _, x, _ in self._logs], [x for *_, x in self._logs]
            groups.append(RelativeLog(out, _joints(a), _rotations(a), _joints(b), _rotations(b)))
        ends = [a for a, _ in self._pairs] + [b for _, b in self._pairs]
        anchors = Anchors(
            point_joint=_joints(ends),
            point_local=np.array([f.translation for f in ends]).reshape(-1, 3),
            direction_joint=np.array([joint for joint, _ in self._directions], np.intp),
            direction_local=np.array([e for _, e in self._directions]).reshape(-1, 3),
        )
        return Closure(anchors, tuple(groups), tuple(self.names), tuple(self.aligned), tuple(self._turned_by))

    def _resolve(self, loop: LoopSpec, pair: int, a: Frame, directions: list[tuple[str, Array]]) -> None:
        world = Frame(0, np.eye(3), np.zeros(3))
        for label, e in directions:
            of_world = loop.rows_in == "world"
            direction = self._direction(world if of_world else a, e, loop.name, "" if of_world else "frame_a")
            self._components.append((self._row(loop.name, label), pair, direction))

    def _row(self, loop: str, label: str) -> int:
        self.names.append((loop, label))
        return len(self.names) - 1

    def _direction(self, frame: Frame, e: Array, loop: str, label: str) -> int:
        self._directions.append((frame.joint, frame.rotation @ e))
        self._turned_by.append((loop, label))
        return len(self._directions) - 1


def _label(e: Array, otherwise: str) -> str:
    at = np.flatnonzero(e)
    return "xyz"[at[0]] if len(at) == 1 and e[at[0]] == 1 else otherwise


def _unit(axis: Sequence[float], where: str) -> Array:
    vector = np.array(axis, dtype=float)
    largest = np.abs(vector).max()
    if not np.isfinite(largest) or largest == 0:
        raise MechanismError(f"{where}: {list(axis)} is no direction; give three finite numbers, not all zero")
    vector /= largest  # whose squares are numbers
    return np.asarray(vector / np.linalg.norm(vector))


def _columns(table: Sequence[tuple[int, ...]]) -> list[np.ndarray[tuple[int], np.dtype[np.intp]]]:
    return [np.array(column, np.intp) for column in zip(*table, strict=True)]


def _joints(frames: Sequence[Frame]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.array([f.joint for f in frames], np.intp)


def _rotations(frames: Sequence[Frame]) -> Array:
    return np.array([f.rotation for f in frames]).reshape(-1, 3, 3)
