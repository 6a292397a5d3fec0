"""The loop closure phi(q') = 0 of eq. 1: which rows each loop type has, and their residuals and Jacobians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.couplings import (
    PiecewiseCurve,
    coefficients_of,
    coupling_name,
    curve_of,
    stack_curves,
    validate_coupling,
)
from ckc_pin.mechanism.frames import Frame, Frames
from ckc_pin.mechanism.pose import Anchors, BodyPose, Pose, Rate
from ckc_pin.mechanism.rows import Affine, Component, Curved, Distance, Dot, RelativeLog, Rows
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec, LoopType
from ckc_pin.mechanism.tree import Tree

__all__ = ["PRESCRIBED_ROW", "Closure", "ClosureBuilder", "perpendicular"]

_XYZ = np.eye(3)
PRESCRIBED_ROW = "prescribed"  # name of the row of a prescribed joint

# Rows of each loop type: of the position, then of the orientation. r = p_A - p_B; a and b are axis_a and axis_b; e1, e2
# and a are a right-handed basis; log is the rotation vector of R_A^T R_B.
LOOP_ROWS: dict[LoopType, tuple[str, str]] = {
    "point": ("r", ""),
    "point_2d": ("e1.r, e2.r", ""),
    "hinge": ("r", "e1.b, e2.b"),
    "cylindrical": ("e1.r, e2.r", "e1.b, e2.b"),
    "universal": ("r", "a.b"),
    "prismatic": ("e1.r, e2.r", "log"),
    "weld": ("r", "log"),
    "distance": ("length", ""),
}


class Closure(Immutable, frozen=True):
    """The constraint rows of all loops and couplings of a mechanism.

    Attributes
    ----------
    anchors : Anchors
        Points and directions that the rows refer to.
    groups : tuple of Rows
        The rows, at most one group of each primitive.
    names : tuple of (loop, row)
        Name of each row of phi, such as ("elbow", "x").
    aligned : tuple of (loop, a, b)
        Numbers of two directions that point the same way (a . b > 0) in an assembled hinge. Its rows alone would also
        hold if they pointed against each other.
    direction_frames : tuple of (loop, frame)
        The frame that each direction of the anchors is fixed in, such as ("elbow", "frame_a"); "" for the world.
    """

    anchors: Anchors
    groups: tuple[Rows, ...]
    names: tuple[tuple[str, str], ...]
    aligned: tuple[tuple[str, int, int], ...]
    direction_frames: tuple[tuple[str, str], ...] = ()

    @property
    def rows(self) -> int:
        """Number of rows of phi."""
        return len(self.names)

    def phi(self, pose: Pose) -> Array:
        """Residual phi, shape (rows,), in metres and radians (eq. 27 for the five-bar)."""
        phi = np.empty(len(self.names))
        for group in self.groups:
            phi[group.out] = group.phi(pose)
        return phi

    def jacobian(self, pose: Pose) -> Array:
        """Constraint Jacobian J = d phi / d q', shape (rows, n)."""
        jacobian = np.empty((len(self.names), pose.tree.n))
        for group in self.groups:
            jacobian[group.out] = group.jacobian(pose)
        return jacobian

    def body_jacobian(self, pose: Pose) -> Array:
        """Derivative of phi with respect to the spatial velocities of the bodies, shape (rows, joints, 6).

        `BodyPose` defines these velocities. Rows of couplings are zero, since they constrain coordinates, not bodies.
        """
        bodies = BodyPose(pose, self.anchors)
        jacobian = np.zeros((len(self.names), 6 * len(pose.translation)))
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
        """Whether each row of phi is a length, shape (rows,); other rows are angles or cosines."""
        metres = np.zeros(len(self.names), dtype=bool)
        for group in self.groups:
            metres[group.out] = group.in_metres(tree)
        return metres

    def largest_residuals(self, phi: Array) -> dict[str, float]:
        """Return the largest |phi| of each loop."""
        worst: dict[str, float] = {}
        for (loop, _), value in zip(self.names, np.abs(phi), strict=True):
            worst[loop] = max(worst.get(loop, 0.0), float(value))
        return worst

    def reversed_hinges(self, pose: Pose) -> list[str]:
        """Return the loops whose axes point against each other (a . b <= 0)."""
        return [loop for loop, a, b in self.aligned if pose.e[a] @ pose.e[b] <= 0]


class Selected(Immutable, frozen=True):
    """A selection of the rows of other groups, as one group."""

    groups: tuple[Rows, ...]
    rows: int
    keep: IntArray

    @property
    def out(self) -> IntArray:
        """Indices of the rows in phi."""
        return np.arange(len(self.keep))

    def _gather(self, parts: list[Array]) -> Array:
        values = np.empty((self.rows, *parts[0].shape[1:]))
        for group, part in zip(self.groups, parts, strict=True):
            values[group.out] = part
        return values[self.keep]

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
    """Return e1 and e2 that complete a right-handed basis (e1, e2, axis).

    For a coordinate axis they are the next two in cyclic order: x and y for z.
    """
    along = int(np.argmax(np.abs(axis)))
    if axis[along] > 0 and np.count_nonzero(axis) == 1:
        return _XYZ[(along + 1) % 3], _XYZ[(along + 2) % 3]
    e1 = np.cross(axis, _XYZ[int(np.argmin(np.abs(axis)))])
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(axis, e1)


class ClosureBuilder:
    """Collects the rows of loops and couplings, then groups them by primitive.

    Parameters
    ----------
    tree : Tree
    frames : Frames
    """

    def __init__(self, tree: Tree, frames: Frames) -> None:
        self.tree = tree
        self.frames = frames
        self.names: list[tuple[str, str]] = []
        self.aligned: list[tuple[str, int, int]] = []
        self._pairs: list[tuple[Frame, Frame]] = []
        self._directions: list[tuple[int, Array]] = []
        self._direction_frames: list[tuple[str, str]] = []
        self._components: list[tuple[int, int, int]] = []  # row, pair, direction
        self._dots: list[tuple[int, int, int]] = []  # row, a, b
        self._distances: list[tuple[int, int, float]] = []  # row, pair, length
        self._affine: list[tuple[int, Array, float]] = []  # row, coefficients, offset
        self._curved: list[tuple[int, Array, float, int, PiecewiseCurve]] = []  # as affine, coordinate, curve
        self._logs: list[tuple[list[int], Frame, Frame]] = []

    def add_loop(self, loop: LoopSpec) -> None:
        """Add the rows of a loop, in the order of `LOOP_ROWS`.

        Raises
        ------
        MechanismError
            Two loops of one name, an unknown frame, frames of one body, an invalid axis, a wrong or missing length.
        """
        where = f"loop {loop.name!r}"
        if loop.name in {name for name, _ in self.names}:
            raise MechanismError(f"{where}: two loops have this name")
        a = self.frames.find(loop.frame_a, f"{where}, frame_a")
        b = self.frames.find(loop.frame_b, f"{where}, frame_b")
        if a.joint == b.joint:
            raise MechanismError(f"{where}: frames A and B belong to the same rigid body; a loop needs two bodies")
        if (loop.length is not None) != (loop.type == "distance"):
            remedy = "needs the key length" if loop.type == "distance" else "has no key length, only 'distance' has"
            raise MechanismError(f"{where}: type {loop.type!r} {remedy}")
        axis_a, axis_b = (_unit(x, f"{where}, {k}") for k, x in (("axis_a", loop.axis_a), ("axis_b", loop.axis_b)))
        e1, e2 = perpendicular(axis_a)
        self._pairs.append((a, b))
        position, orientation = LOOP_ROWS[loop.type]
        if position == "r":
            self._add_components(loop, a, [("x", _XYZ[0]), ("y", _XYZ[1]), ("z", _XYZ[2])])
        elif position == "e1.r, e2.r":
            self._add_components(loop, a, [(_label(e1, "e1"), e1), (_label(e2, "e2"), e2)])
        elif loop.length is not None:
            self._distances.append((self._add_row(loop.name, "length"), len(self._pairs) - 1, loop.length))
        if orientation == "e1.b, e2.b":
            b_number = self._add_direction(b, axis_b, loop.name, "frame_b")
            for label, e in (("e1.b", e1), ("e2.b", e2)):
                row = self._add_row(loop.name, label)
                self._dots.append((row, self._add_direction(a, e, loop.name, "frame_a"), b_number))
            self.aligned.append((loop.name, self._add_direction(a, axis_a, loop.name, "frame_a"), b_number))
        elif orientation == "a.b":
            row = self._add_row(loop.name, "a.b")
            a_number = self._add_direction(a, axis_a, loop.name, "frame_a")
            self._dots.append((row, a_number, self._add_direction(b, axis_b, loop.name, "frame_b")))
        elif orientation == "log":
            self._logs.append(([self._add_row(loop.name, label) for label in ("rx", "ry", "rz")], a, b))

    def add_coupling(self, coupling: CouplingSpec) -> None:
        """Add the row of a coupling: sum of coefficient * joint - curve(other) - offset = 0.

        Raises
        ------
        MechanismError
            The coupling is incomplete, contradictory, or names a joint that is not there.
        """
        validate_coupling(coupling)
        name, curve = coupling_name(coupling), curve_of(coupling)
        where = f"coupling {name!r}"
        coefficients = np.zeros(self.tree.n)
        for joint, coefficient in coefficients_of(coupling).items():
            coefficients[self.tree.joint_index(joint, where)] = coefficient
        row = self._add_row(name, "coupling")
        if curve is None:
            self._affine.append((row, coefficients, coupling.offset))
        else:
            other = self.tree.joint_index(str(coupling.other), where)
            self._curved.append((row, coefficients, coupling.offset, other, curve))

    def add_prescribed(self, joint: str, value: float) -> None:
        """Add the row joint - value = 0, whose value the native loop moves in time."""
        coefficients = np.zeros(self.tree.n)
        coefficients[self.tree.joint_index(joint, "prescribed")] = 1.0
        self._affine.append((self._add_row(joint, PRESCRIBED_ROW), coefficients, value))

    def build(self) -> Closure:
        """Return the closure, with at most one group of each primitive."""
        groups: list[Rows] = []
        if self._components:
            out, pair, direction = _columns(self._components)
            is_turning = any(self._directions[k][0] != 0 for k in direction)
            groups.append(Component(out, pair, direction, is_turning))
        if self._dots:
            groups.append(Dot(*_columns(self._dots)))
        if self._distances:
            out, pair = _columns([(row, k) for row, k, _ in self._distances])
            groups.append(Distance(out, pair, np.array([length for *_, length in self._distances])))
        if self._affine:
            rows, coefficients, offsets = zip(*self._affine, strict=True)
            groups.append(Affine(np.array(rows, np.intp), np.array(coefficients), np.array(offsets)))
        if self._curved:
            rows, coefficients, offsets, others, curves = zip(*self._curved, strict=True)
            linear = np.array(rows, np.intp), np.array(coefficients), np.array(offsets)
            groups.append(Curved(*linear, np.array(others, np.intp), *stack_curves(curves)))
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
        return Closure(anchors, tuple(groups), tuple(self.names), tuple(self.aligned), tuple(self._direction_frames))

    def _add_components(self, loop: LoopSpec, a: Frame, directions: list[tuple[str, Array]]) -> None:
        """Add rows e . (p_A - p_B) of the last pair, with e fixed in frame A or in the world."""
        in_world = loop.rows_in == "world"
        frame = Frame(0, np.eye(3), np.zeros(3)) if in_world else a
        for label, e in directions:
            direction = self._add_direction(frame, e, loop.name, "" if in_world else "frame_a")
            self._components.append((self._add_row(loop.name, label), len(self._pairs) - 1, direction))

    def _add_row(self, loop: str, label: str) -> int:
        self.names.append((loop, label))
        return len(self.names) - 1

    def _add_direction(self, frame: Frame, e: Array, loop: str, label: str) -> int:
        self._directions.append((frame.joint, frame.rotation @ e))
        self._direction_frames.append((loop, label))
        return len(self._directions) - 1


def _label(e: Array, default: str) -> str:
    """Return "x", "y" or "z" for a coordinate axis."""
    nonzero = np.flatnonzero(e)
    return "xyz"[nonzero[0]] if len(nonzero) == 1 and e[nonzero[0]] == 1 else default


def _unit(axis: Sequence[float], where: str) -> Array:
    vector = np.array(axis, dtype=float)
    largest = np.abs(vector).max()
    if not np.isfinite(largest) or largest == 0:
        raise MechanismError(f"{where}: {list(axis)} is not a direction; give three finite numbers, not all zero")
    vector /= largest  # so that the squares in the norm neither overflow nor vanish
    return np.asarray(vector / np.linalg.norm(vector))


def _columns(table: Sequence[tuple[int, ...]]) -> list[np.ndarray[tuple[int], np.dtype[np.intp]]]:
    return [np.array(column, np.intp) for column in zip(*table, strict=True)]


def _joints(frames: Sequence[Frame]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.array([f.joint for f in frames], np.intp)


def _rotations(frames: Sequence[Frame]) -> Array:
    return np.array([f.rotation for f in frames]).reshape(-1, 3, 3)
