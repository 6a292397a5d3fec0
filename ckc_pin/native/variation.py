"""How a motion changes with parameters, as the tables that cross to C++.

Lengths, angles and placements are coordinates of joints that are locked: a prismatic or revolute joint of no mass where
a joint or a frame is placed. So their derivatives are what Pinocchio's and the rows' are along any coordinate. Where
terms are written out, a number is a direction in the space of the numbers that the code takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.arguments import present, values
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.mechanism.spec import FrameSpec
from ckc_pin.mechanism.tree import Tree
from ckc_pin.native.tables import core_table, packed

__all__ = ["Effect", "Lock", "Place", "SensitivityParameter", "directions_of", "separate_parts", "variation_table"]

Place = Literal["joint", "point", "spring", "direction", "log_a", "log_b", "reported"]

ACTING = (
    "friction",
    "gain_q",
    "gain_q_dot",
    "target",
    "gear",
    "torque_limit",
    "restitution",
    "lower",
    "upper",
)  # not terms


@dataclass(frozen=True)
class Lock:
    """A joint that is locked where something is placed.

    Attributes
    ----------
    placed : str
        What stands on it: a joint, a point of a loop, an end of a spring, a direction, a relative rotation's frame, or
        a point that is only reported.
    carrier : int
        The joint that it is placed in.
    axis : (3,) array
        Of unit length, in the carrier's axes through its origin.
    turns : bool
        About that axis, or along it.
    """

    placed: Place
    carrier: int
    axis: Array
    turns: bool = False


@dataclass(frozen=True)
class Effect:
    """One of the ways in which a number acts; they add up.

    Attributes
    ----------
    kind : str
        As `Effect` in src/sensitivity/sensitivities.hpp.
    index : int
        Of what it is: a coordinate, a joint, a spring, a row, a motor; of a placement what is placed.
    numbers : array
        How what it changes does so: an inertia's ten, gravity's three; of a placement how far its joint moves.
    lock : Lock or None
        Of a placement.
    """

    kind: str
    index: int = 0
    numbers: Array = field(default_factory=lambda: np.zeros(0))
    lock: Lock | None = None

    @property
    def is_term(self) -> bool:
        """Whether the terms of eq. 1 change with it, and not only what acts or what joints do."""
        return self.kind not in ACTING

    @property
    def is_shape(self) -> bool:
        """Whether where the loops close depends on it."""
        if self.lock is not None:
            return self.lock.placed != "spring"
        return self.kind in ("length", "offset", "ratio")


@dataclass(frozen=True)
class SensitivityParameter:
    """A parameter whose sensitivities are integrated along a run.

    Attributes
    ----------
    name : str
    effects : tuple of Effect
    q : (n,) array or None
        Derivative of the start's coordinates, as a tangent vector.
    q_dot : (d,) array or None
        Derivative of the start's independent rates.
    places : tuple of Effect
        Effects on the placement of joints and of reported points.
    assembled_at : int
        Coordinate whose stop the assembled start touches, if this parameter moves that stop and the start follows it
        in one direction only; -1 otherwise.
    slopes : mapping of str to arrays
        Derivatives of the model's numbers (`ParameterMap.derivative`).
    """

    name: str
    effects: tuple[Effect, ...] = ()
    q: Array | None = None
    q_dot: Array | None = None
    places: tuple[Effect, ...] = ()
    assembled_at: int = -1
    slopes: Mapping[str, Array] = field(default_factory=dict)


# --- where terms are written out ---------------------------------------------------------------------


def directions_of(
    mechanism: Mechanism, parameters: Sequence[SensitivityParameter]
) -> tuple[dict[str, BoolArray], Array] | None:
    """Return the arguments that compiled terms need for derivatives with respect to parameters, and those directions.

    Returns
    -------
    dict of str to bool arrays
        As `present` returns it, with numbers that are zero and vary.
    (arguments, parameters) array
        Derivatives of the arguments.
    None where a parameter turns a joint or a direction, or a body has no mass: those are no arguments.
    """
    numbers = model_numbers(mechanism)
    which = present(numbers)
    for x in parameters:
        if any(effect.lock is not None and effect.lock.turns for effect in x.effects):
            return None
        if any(effect.kind == "inertia" and numbers["mass"][effect.index] <= 0.0 for effect in x.effects):
            return None
        for key in numbers:
            if key in x.slopes:
                which[key] = which[key] | (x.slopes[key] != 0.0)
    zeros = {key: np.zeros_like(x) for key, x in numbers.items()}
    columns = [values({key: x.slopes.get(key, zeros[key]) for key in numbers}, which) for x in parameters]
    return which, np.array(columns).T


# --- in general --------------------------------------------------------------------------------------


def variation_table(
    mechanism: Mechanism,
    parameters: Sequence[SensitivityParameter],
    directions: Array | None,
    *,
    at_equilibrium: bool,
    target: Array,
    controlled: bool,
) -> dict[str, Any]:
    """Describe what varies.

    `directions`: as of `directions_of`, where compiled terms can take them. `at_equilibrium`: the start is where
    the mechanism rests, which moves with it. `target`: q' where a controller compensates what this mechanism needs
    there; none where it compensates another one's. `controlled`: a controller acts, which may look at every joint.
    """
    tree = mechanism.tree
    locks = _Locks([effect for x in parameters for effect in x.effects if effect.lock is not None])
    model = pin.Model()
    model.gravity.linear = tree.model.gravity.linear
    plain = core_table(mechanism)
    closure, springs = plain["closure"], plain["springs"]
    joint_at = [0]
    locks.add_ends(model, 0, 0)
    for joint in range(1, tree.model.njoints):
        parent = locks.add(model, ("joint", joint), joint_at[tree.model.parents[joint]])
        at = model.addJoint(
            parent, tree.model.joints[joint], tree.model.jointPlacements[joint], tree.model.names[joint]
        )
        model.appendBodyToJoint(at, tree.model.inertias[joint], pin.SE3.Identity())
        joint_at.append(at)
        locks.add_ends(model, joint, at)  # at once: Pinocchio wants branches whole
    for table in (closure, springs):
        for key in ("point_joint", "direction_joint"):
            table[key] = [joint_at[k] for k in table.get(key, [])]
    closure["log"] = [[*row[:3], *(joint_at[k] for k in row[3:])] for row in closure["log"]]
    for (placed, index), at in locks.ends.items():
        if placed in ("log_a", "log_b"):
            closure["log"][index][3 if placed == "log_a" else 4] = at
        elif placed == "direction":
            closure["direction_joint"][index] = at
        else:
            (closure if placed == "point" else springs)["point_joint"][index] = at
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

    def crossing(effect: Effect) -> tuple[str, int, Array]:
        index = effect.index
        if effect.lock is not None:
            index = model.joints[locks.joint[id(effect)]].idx_v
        elif effect.kind == "inertia":
            index = joint_at[index]
        return effect.kind, index, effect.numbers

    return {
        "model": packed(model),
        "place": Tree(model).q_index.tolist(),
        "real_q": real_q.tolist(),
        "real_v": real_v.tolist(),
        "closure": closure,
        "springs": springs,
        "own": mechanism.partition.q.tolist(),
        "at_equilibrium": at_equilibrium,
        "target": target,
        "turns": np.asfortranarray(mechanism.motors.transmission),
        "parameters": [
            ([crossing(effect) for effect in x.effects], np.zeros(tree.n) if x.q is None else x.q,
             np.zeros(mechanism.d) if x.q_dot is None else x.q_dot, x.assembled_at)
            for x in parameters
        ],
        "part": [0] * tree.n if controlled else separate_parts(mechanism),
        "directions": np.zeros((0, len(parameters))) if directions is None else np.asfortranarray(directions),
    }  # fmt: skip


def separate_parts(mechanism: Mechanism) -> list[int]:
    """Number, by coordinate, the parts of a mechanism that no body, loop, coupling or spring connects."""
    model, frames, spec = mechanism.tree.model, mechanism.frames, mechanism.spec
    part = list(range(model.njoints))  # by joint; the world connects nothing

    def connect(*joints: int) -> None:
        numbers = {part[joint] for joint in joints if joint}
        for joint in range(1, model.njoints):
            if part[joint] in numbers:
                part[joint] = min(numbers)

    def carrier(frame: str | FrameSpec | None) -> int:
        name = frame if isinstance(frame, str) else "world" if frame is None else frame.link
        return frames.find(name, "parameters").joint

    for joint in range(1, model.njoints):
        connect(joint, model.parents[joint])
    for loop in spec.loop:
        connect(carrier(loop.frame_a), carrier(loop.frame_b))
    for spring in spec.spring:
        if spring.joint is None:
            connect(carrier(spring.frame_a), carrier(spring.frame_b))
    for coupling in spec.coupling:
        connect(model.getJointId(coupling.joint), model.getJointId(coupling.other))
    of_joint = {number: k for k, number in enumerate(dict.fromkeys(part[1:]))}
    found = [0] * model.nv
    for joint in range(1, model.njoints):
        first = model.joints[joint].idx_v
        found[first : first + model.joints[joint].nv] = [of_joint[part[joint]]] * model.joints[joint].nv
    return found


class _Locks:
    """The joints that are locked: in a chain where several numbers place the same."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self._effects = effects
        self.joint: dict[int, int] = {}  # by effect
        self.ends: dict[tuple[Place, int], int] = {}  # by what stands on it, but for joints: the last of a chain

    def add(self, model: Any, thing: tuple[Place, int], parent: int) -> int:
        """Add those that one thing stands on; return what it stands on then."""
        for effect in self._effects:
            assert effect.lock is not None
            if (effect.lock.placed, effect.index) == thing:
                kind = pin.JointModelRevoluteUnaligned if effect.lock.turns else pin.JointModelPrismaticUnaligned
                name = f"lock {len(self.joint)}"
                parent = int(model.addJoint(parent, kind(np.array(effect.lock.axis)), pin.SE3.Identity(), name))
                self.joint[id(effect)] = parent
        return parent

    def add_ends(self, model: Any, joint: int, at: int) -> None:
        """Add those that points, directions and ends of springs on a joint stand on."""
        for effect in self._effects:
            assert effect.lock is not None
            thing = (effect.lock.placed, effect.index)
            if effect.lock.placed != "joint" and effect.lock.carrier == joint and thing not in self.ends:
                self.ends[thing] = self.add(model, thing, at)


def _spread(table: Array, columns: Any, count: int) -> Array:
    """Put the columns of the mechanism's coordinates among all."""
    wide = np.zeros((*np.shape(table)[:-1], count))
    wide[..., columns] = table
    return wide
