"""How a motion changes with parameters, as the tables that cross to C++.

Lengths and placements are coordinates of joints that are locked: a prismatic joint of no mass where a joint or a frame
is placed. So their derivatives are what Pinocchio's and the rows' are along any coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array, Tree
from ckc_pin.native.tables import core_table, packed

__all__ = ["Varying", "variation_table"]

Place = Literal["joint", "point", "spring"]


@dataclass(frozen=True)
class Varying:
    """One number that a motion's change with is wanted.

    Attributes
    ----------
    name : str
    kind : str
        As `Parameter` in variation.hpp.
    index : int
        Of what it is: a coordinate, a joint, a spring, a row.
    numbers : array
        Of an inertia, of gravity, of a gain: how they change.
    placed, carrier, axis : str, int, (3,) array
        Of a placement: what is placed there (`index` says which joint, point of a loop, or end of a spring), the joint
        that it is placed in, and along which of that one's directions.
    q : (n,) array
        How the start's independent coordinates change, tangent.
    q_dot : (d,) array
    """

    name: str
    kind: str
    index: int = 0
    numbers: Array = field(default_factory=lambda: np.zeros(0))
    placed: Place = "joint"
    carrier: int = 0
    axis: Array = field(default_factory=lambda: np.zeros(3))
    q: Array | None = None
    q_dot: Array | None = None


def variation_table(
    mechanism: Mechanism, varying: Sequence[Varying], *, at_equilibrium: bool, target: Array
) -> dict[str, Any]:
    """Describe what varies.

    `at_equilibrium`: the start is where the mechanism rests, which moves with it. `target`: q' where a controller
    compensates what this mechanism needs there; none where it compensates another one's.
    """
    tree, locked = mechanism.tree, [x for x in varying if x.kind == "placement"]
    model = pin.Model()
    model.gravity.linear = tree.model.gravity.linear
    plain = core_table(mechanism)
    closure, springs = plain["closure"], plain["springs"]
    column: dict[str, int] = {}
    joint_at, ends = [0], _ends(model, locked, 0, 0, column)
    for joint in range(1, tree.model.njoints):
        parent = joint_at[tree.model.parents[joint]]
        for x in locked:
            if x.placed == "joint" and x.index == joint:
                parent = _lock(model, parent, x, column)
        at = model.addJoint(
            parent, tree.model.joints[joint], tree.model.jointPlacements[joint], tree.model.names[joint]
        )
        model.appendBodyToJoint(at, tree.model.inertias[joint], pin.SE3.Identity())
        joint_at.append(at)
        ends |= _ends(model, locked, joint, at, column)  # at once: Pinocchio wants branches whole
    for table in (closure, springs):
        for key in ("point_joint", "direction_joint"):
            table[key] = [joint_at[k] for k in table.get(key, [])]
    closure["log"] = [[*row[:3], *(joint_at[k] for k in row[3:])] for row in closure["log"]]
    for (placed, end), at in ends.items():
        (closure if placed == "point" else springs)["point_joint"][end] = at
    joints = [(tree.model.joints[k], model.joints[joint_at[k]]) for k in range(1, tree.model.njoints)]
    real_q, real_v = np.zeros(tree.nq, np.intp), np.zeros(tree.n, np.intp)
    for own, there in joints:
        real_q[own.idx_q : own.idx_q + own.nq] = np.arange(there.idx_q, there.idx_q + there.nq)
        real_v[own.idx_v : own.idx_v + own.nv] = np.arange(there.idx_v, there.idx_v + there.nv)
    armature = np.zeros(model.nv)
    armature[real_v] = tree.model.armature
    model.armature = armature
    closure["affine_matrix"] = _spread(closure["affine_matrix"], real_v, model.nv)
    for key in ("joint_stiffness", "joint_rest", "joint_damping", "constant"):
        springs[key] = _spread(springs[key], real_v, model.nv)
    index = {x.name: model.joints[column[x.name]].idx_v if x.name in column else x.index for x in varying}
    return {
        "model": packed(model),
        "place": Tree(model).place.tolist(),
        "real_q": real_q.tolist(),
        "real_v": real_v.tolist(),
        "closure": closure,
        "springs": springs,
        "own": mechanism.partition.q.tolist(),
        "at_equilibrium": at_equilibrium,
        "target": target,
        "parameters": [
            (x.kind, joint_at[x.index] if x.kind == "inertia" else index[x.name], x.numbers,
             np.zeros(tree.n) if x.q is None else x.q, np.zeros(mechanism.d) if x.q_dot is None else x.q_dot)
            for x in varying
        ],
    }  # fmt: skip


def _ends(
    model: Any, locked: Sequence[Varying], joint: int, at: int, column: dict[str, int]
) -> dict[tuple[str, int], int]:
    """Add what the points and ends of springs on a joint stand on; say which, by what they are."""
    found: dict[tuple[str, int], int] = {}
    for x in locked:
        if x.placed != "joint" and x.carrier == joint:
            key = (x.placed, x.index)
            found[key] = _lock(model, found.get(key, at), x, column)
    return found


def _lock(model: Any, parent: int, x: Varying, column: dict[str, int]) -> int:
    joint = pin.JointModelPrismaticUnaligned(np.array(x.axis))
    column[x.name] = int(model.addJoint(parent, joint, pin.SE3.Identity(), x.name))
    return column[x.name]


def _spread(table: Array, columns: Any, count: int) -> Array:
    """Put the columns of the mechanism's coordinates among all."""
    wide = np.zeros((*np.shape(table)[:-1], count))
    wide[..., columns] = table
    return wide
