"""The closure with more rows: what the independent coordinates are, and where a point of the mechanism is.

Eq. 3 stacks phi(q') and S q' - q to say that q determines q'. A point's coordinates p(q') can stand where S q'
does: then they determine q', and following them is inverse kinematics. `Extended` has all these rows in one closure;
`Task` selects those whose values are given, on the level set phi = 0, S q' = q or p(q') = x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

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

__all__ = ["Extended", "Task", "extend_closure", "find_point"]

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Extended:
    """The rows [phi; S q'; p; log R] of a mechanism and one of its points.

    Attributes
    ----------
    mechanism : Mechanism
    point : str or None
    closure : Closure
    loops, joints, place : int arrays
        Which rows they are: of phi; the independent coordinates in their order; the point's position in the world,
        three rows or none, and where that does not tell the configuration three for the turn of its frame from how
        it is assembled.
    free : int array
        The rows of phi without the redundant ones.
    fixing : int array
        d rows of `place` that determine the configuration: positions first, turns where those leave freedoms.
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
        """Return all rows at a configuration; every coordinate counts as dependent."""
        none, every = np.zeros(0, np.intp), np.arange(self.mechanism.n)
        return Kinematics(self.mechanism.tree, self.closure, Partition(none, every), q_tree)

    def axis(self, row: int) -> str:
        """Name a row of `place`: x, y, z, or a turn rx, ry, rz."""
        return AXES[row - int(self.place[0])]


@dataclass(frozen=True)
class Task:
    """d rows whose values are given, and with phi = 0 determine the configuration: Psi of eq. 3.

    Attributes
    ----------
    extended : Extended
    rows : (d,) int array
    """

    extended: Extended
    rows: IntArray

    @property
    def every(self) -> IntArray:
        """The rows of Psi, n of them: those of phi that are not redundant, then the given ones."""
        return np.concatenate([self.extended.free, self.rows])

    def level(self, given: Array) -> Array:
        """Psi's wanted values (count, n) from the given ones (count, d)."""
        return np.hstack([np.zeros((len(given), len(self.extended.free))), given])

    def evaluate(self, q_tree: Array) -> tuple[Array, Array]:
        """All rows and their Jacobians at configurations (count, nq)."""
        return evaluate_closure(self.extended.mechanism.tree, self.extended.closure, q_tree)


def find_point(mechanism: Mechanism, name: str | None = None) -> str:
    """Return the name of a point, the first one unless given.

    Raises
    ------
    InputError
        There is no such point.
    """
    if not mechanism.points:
        raise InputError(
            f"{mechanism.name}: it has no point; name one in its mechanism.toml: [[point]], name = ..., frame = ..."
        )
    if name is not None and name not in mechanism.points:
        raise InputError(f"no point {name!r} in {mechanism.name}; there are {', '.join(mechanism.points)}")
    return name or next(iter(mechanism.points))


def extend_closure(mechanism: Mechanism, point: str | None = None) -> Extended:
    """Add the rows of the independent coordinates, and those of a point where one is named.

    Raises
    ------
    InputError
        No such point, or one that does not tell the configuration.
    """
    single = [k for k in mechanism.partition.q if mechanism.coordinates[k] not in mechanism.tree.free_coordinates]
    closure = join_closures(mechanism.closure, _joint_rows(mechanism, single))
    rows, with_joints = mechanism.closure.rows, closure.rows
    chosen = np.zeros(0, np.intp)
    if point is not None:
        chosen = _fixing(mechanism, point)
        closure = join_closures(closure, _point_rows(mechanism, point, "weld" if np.any(chosen >= 3) else "point"))
    names = [".".join(name) for name in mechanism.closure.names]
    return Extended(
        mechanism=mechanism,
        point=point,
        closure=closure,
        loops=np.arange(rows),
        joints=np.arange(rows, with_joints),
        place=np.arange(with_joints, closure.rows),
        free=np.array([k for k, name in enumerate(names) if name not in mechanism.redundant], np.intp),
        fixing=with_joints + chosen,
    )


def _joint_rows(mechanism: Mechanism, at: Sequence[int]) -> Closure:
    nowhere = Anchors(np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros(0, np.intp), np.zeros((0, 3)))
    select = np.zeros((len(at), mechanism.n))
    select[np.arange(len(at)), at] = 1.0
    names = tuple((mechanism.coordinates[k], "q") for k in at)
    return Closure(nowhere, (Affine(np.arange(len(at)), select, np.zeros(len(at))),), names, ())


def _point_rows(mechanism: Mechanism, name: str, kind: Literal["point", "weld"]) -> Closure:
    """Return a loop from the point's frame to the world: its rows are where the point, or its frame, is."""
    frame = next(p.frame for p in mechanism.spec.point if p.name == name)
    found = mechanism.points[name]
    if found.joint == 0:
        raise InputError(f"point {name!r} of {mechanism.name} is fixed in the world: it cannot be moved")
    turned = mechanism.assembled.pose.rotation[found.joint] @ found.rotation
    roll_pitch_yaw = tuple(float(x) for x in pin.rpy.matrixToRpy(turned))
    builder = ClosureBuilder(mechanism.tree, mechanism.frames)
    world = FrameSpec(link="world", rpy=roll_pitch_yaw)  # type: ignore[arg-type]
    builder.add_loop(LoopSpec(name=name, type=kind, frame_a=frame, frame_b=world, rows_in="world"))
    return builder.build()


def _fixing(mechanism: Mechanism, point: str) -> IntArray:
    """Choose d of the six rows of a place, each the one that adds most; turns only when positions add nothing."""
    at = mechanism.assembled
    frame = Kinematics(mechanism.tree, _point_rows(mechanism, point, "weld"), at.partition, mechanism.q_tree)
    moves = frame.J @ at.rho * mechanism.tree.step_scale[at.partition.q]
    moves[:3] /= mechanism.size
    least = RANK_TOLERANCE * max(1.0, float(np.abs(moves).max(initial=0.0)))
    chosen: list[int] = []
    for block in (range(3), range(3, 6)):
        while len(chosen) < mechanism.d:
            sizes = np.array([np.linalg.norm(moves[k]) if k in block else 0.0 for k in range(6)])
            best = int(np.argmax(np.round(sizes / least)))  # of equals the first
            if sizes[best] <= least:
                break
            along = moves[best] / sizes[best]
            moves = moves - np.outer(moves @ along, along)
            chosen.append(best)
    if len(chosen) < mechanism.d:
        raise InputError(
            f"{mechanism.name}: place and orientation of the point {point!r} fix {len(chosen)} of its {mechanism.d} "
            "freedoms; name a point of a body that all of them move"
        )
    return np.sort(np.array(chosen, np.intp))
