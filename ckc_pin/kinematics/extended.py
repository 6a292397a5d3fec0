"""The closure extended by rows for the independent coordinates and for the position of a point.

Eq. 3 stacks phi(q') and S q' - q, so that q determines q'. A point's coordinates p(q') can take the place of S q': then
they determine q', and solving for q' is inverse kinematics. `ExtendedClosure` has all these rows. `Task` selects d rows
whose values are prescribed: S q' = q, or p(q') = x.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pinocchio as pin
from msgspec import Struct

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.mechanism.batch import evaluate_closure, join_closures
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors
from ckc_pin.mechanism.rank import RANK_TOLERANCE
from ckc_pin.mechanism.rows import Affine
from ckc_pin.mechanism.spec import FrameSpec, LoopSpec

__all__ = ["ExtendedClosure", "Task", "extend_closure", "find_point"]

AXES = ("x", "y", "z", "rx", "ry", "rz")


class ExtendedClosure(Struct, frozen=True):
    """The rows [phi; S q'; p; log R] of a mechanism and one of its points.

    Attributes
    ----------
    mechanism : Mechanism
    point : str or None
    closure : Closure
    loops, joints, place : int arrays
        Numbers of the rows: of phi, of the independent coordinates in their order, and of the point. The point has
        three rows for its position in the world, and three more for the rotation of its frame from the assembled
        configuration if the position does not determine the configuration. Without a point there are none.
    free : int array
        Rows of phi without the redundant ones.
    fixing : int array
        d rows of `place` that determine the configuration: positions first, then rotations if necessary.
    """

    mechanism: Mechanism
    point: str | None
    closure: Closure
    loops: IntArray
    joints: IntArray
    place: IntArray
    free: IntArray
    fixing: IntArray

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return all rows at a configuration, with all coordinates as dependent ones."""
        partition = Partition(np.zeros(0, np.intp), np.arange(self.mechanism.n))
        return Kinematics(self.mechanism.tree, self.closure, partition, q_tree)

    def axis(self, row: int) -> str:
        """Return the name of a row of `place`: x, y, z, rx, ry or rz."""
        return AXES[row - int(self.place[0])]


class Task(Struct, frozen=True):
    """d rows with prescribed values, which together with phi = 0 determine the configuration: Psi of eq. 3.

    Attributes
    ----------
    extended : ExtendedClosure
    rows : (d,) int array
    """

    extended: ExtendedClosure
    rows: IntArray

    @property
    def psi_rows(self) -> IntArray:
        """The n rows of Psi: the rows of phi that are not redundant, then the prescribed rows."""
        return np.concatenate([self.extended.free, self.rows])

    def psi_values(self, values: Array) -> Array:
        """Return the values of Psi, shape (count, n), for prescribed values (count, d)."""
        return np.hstack([np.zeros((len(values), len(self.extended.free))), values])

    def evaluate(self, q_tree: Array) -> tuple[Array, Array]:
        """Return all rows, shape (count, rows), and their Jacobians (count, rows, n) at configurations (count, nq)."""
        return evaluate_closure(self.extended.mechanism.tree, self.extended.closure, q_tree)


def find_point(mechanism: Mechanism, name: str | None = None) -> str:
    """Return the name of a point of a mechanism. Default: the first one.

    Raises
    ------
    InputError
        There is no such point, or no point at all.
    """
    if not mechanism.points:
        raise InputError(
            f"{mechanism.name}: it has no point; add one to its mechanism.toml: [[point]], name = ..., frame = ..."
        )
    if name is not None and name not in mechanism.points:
        raise InputError(f"no point {name!r} in {mechanism.name}; there are {', '.join(mechanism.points)}")
    return name or next(iter(mechanism.points))


def extend_closure(mechanism: Mechanism, point: str | None = None) -> ExtendedClosure:
    """Return the closure extended by the independent coordinates, and by a point if one is named.

    Raises
    ------
    InputError
        There is no such point, or its position and rotation do not determine the configuration.
    """
    of_joints = [k for k in mechanism.partition.q if mechanism.coordinates[k] not in mechanism.tree.free_coordinates]
    closure = join_closures(mechanism.closure, _joint_rows(mechanism, of_joints))
    rows, with_joints = mechanism.closure.rows, closure.rows
    fixing = np.zeros(0, np.intp)
    if point is not None:
        fixing = _choose_rows(mechanism, point)
        closure = join_closures(closure, _point_rows(mechanism, point, "weld" if np.any(fixing >= 3) else "point"))
    names = [".".join(name) for name in mechanism.closure.names]
    return ExtendedClosure(
        mechanism=mechanism,
        point=point,
        closure=closure,
        loops=np.arange(rows),
        joints=np.arange(rows, with_joints),
        place=np.arange(with_joints, closure.rows),
        free=np.array([k for k, name in enumerate(names) if name not in mechanism.redundant], np.intp),
        fixing=with_joints + fixing,
    )


def _joint_rows(mechanism: Mechanism, at: Sequence[int]) -> Closure:
    anchors = Anchors(np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros(0, np.intp), np.zeros((0, 3)))
    select = np.zeros((len(at), mechanism.n))
    select[np.arange(len(at)), at] = 1.0
    names = tuple((mechanism.coordinates[k], "q") for k in at)
    return Closure(anchors, (Affine(np.arange(len(at)), select, np.zeros(len(at))),), names, ())


def _point_rows(mechanism: Mechanism, name: str, kind: Literal["point", "weld"]) -> Closure:
    """Return a loop from the point's frame to the world, whose rows are the position, or pose, of the frame."""
    frame = next(p.frame for p in mechanism.spec.point if p.name == name)
    placed = mechanism.points[name]
    if placed.joint == 0:
        raise InputError(f"point {name!r} of {mechanism.name} is fixed in the world: it cannot be moved")
    rotation = mechanism.assembled.pose.rotation[placed.joint] @ placed.rotation
    roll_pitch_yaw = tuple(float(x) for x in pin.rpy.matrixToRpy(rotation))
    builder = ClosureBuilder(mechanism.tree, mechanism.frames)
    world = FrameSpec(link="world", rpy=roll_pitch_yaw)  # type: ignore[arg-type]
    builder.add_loop(LoopSpec(name=name, type=kind, frame_a=frame, frame_b=world, rows_in="world"))
    return builder.build()


def _choose_rows(mechanism: Mechanism, point: str) -> IntArray:
    """Choose d of the six rows of a point's pose by pivoting; rotations only if positions do not add to the rank."""
    at = mechanism.assembled
    frame = Kinematics(mechanism.tree, _point_rows(mechanism, point, "weld"), at.partition, mechanism.q_tree)
    moves = frame.J @ at.rho * mechanism.tree.step_scale[at.partition.q]
    moves[:3] /= mechanism.size
    threshold = RANK_TOLERANCE * max(1.0, float(np.abs(moves).max(initial=0.0)))
    chosen: list[int] = []
    for block in (range(3), range(3, 6)):
        while len(chosen) < mechanism.d:
            sizes = np.array([np.linalg.norm(moves[k]) if k in block else 0.0 for k in range(6)])
            best = int(np.argmax(np.round(sizes / threshold)))  # of equal sizes the first
            if sizes[best] <= threshold:
                break
            direction = moves[best] / sizes[best]
            moves = moves - np.outer(moves @ direction, direction)
            chosen.append(best)
    if len(chosen) < mechanism.d:
        raise InputError(
            f"{mechanism.name}: position and orientation of the point {point!r} determine {len(chosen)} of its "
            f"{mechanism.d} freedoms; name a point of a body that all freedoms move"
        )
    return np.sort(np.array(chosen, np.intp))
