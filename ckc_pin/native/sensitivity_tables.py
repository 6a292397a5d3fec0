"""Derivatives of the equations of motion with respect to parameters, as tables for the C++ core.

A length, an angle or a placement is the coordinate of a locked joint: a massless prismatic or revolute joint where a
joint or a frame is placed. Its derivative is then one of Pinocchio's and of the constraint rows' along a coordinate.
With compiled terms, a parameter is a direction in the space of the arguments of the compiled code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from msgspec import Struct, field

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.arguments import present, values
from ckc_pin.mechanism.couplings import coupled_joints
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.mechanism.spec import FrameSpec
from ckc_pin.mechanism.tree import Tree
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table, packed

__all__ = [
    "ParameterDerivative",
    "PlacedKind",
    "PlacementJoint",
    "SensitivityParameter",
    "argument_directions",
    "sensitivity_table",
    "separate_parts",
]

PlacedKind = Literal["joint", "point", "spring", "direction", "log_a", "log_b", "reported"]

NOT_TERMS = (  # kinds of friction, stops, controllers and motors, on which the terms of eq. 1 do not depend
    "friction",
    "gain_q",
    "gain_q_dot",
    "target",
    "gear",
    "torque_limit",
    "restitution",
    "lower",
    "upper",
)


class PlacementJoint(Struct, frozen=True):
    """A massless, locked joint whose coordinate is a placement parameter.

    Attributes
    ----------
    placed : str
        Kind of the object that it carries: a joint, a point of a loop, an end of a spring, a direction, a frame of a
        relative rotation, or a reported point.
    carrier : int
        Index of the joint that carries it.
    axis : (3,) array
        Unit vector in the carrier's axes, through its origin.
    revolute : bool
        Whether it rotates about the axis; otherwise it slides along it.
    """

    placed: PlacedKind
    carrier: int
    axis: Array
    revolute: bool = False


class ParameterDerivative(Struct, frozen=True):
    """One term of the derivative of the equations of motion with respect to a parameter; the terms add up.

    Attributes
    ----------
    kind : str
        The name of a `ParameterDerivativeKind` of the core, in lower case.
    index : int
        Index of the coordinate, joint, spring, row or motor; of a placement, of what is placed.
    values : array
        Derivative of the quantity: 10 values of an inertia, 3 of gravity; of a placement, of the joint's coordinate.
    placement : PlacementJoint or None
        The joint of a placement.
    """

    kind: str
    index: int = 0
    values: Array = field(default_factory=lambda: np.zeros(0))
    placement: PlacementJoint | None = None

    @property
    def changes_terms(self) -> bool:
        """Whether the terms of eq. 1 depend on the parameter."""
        return self.kind not in NOT_TERMS

    @property
    def changes_closure(self) -> bool:
        """Whether the constraint function depends on the parameter."""
        if self.placement is not None:
            return self.placement.placed != "spring"
        return self.kind in ("length", "offset", "coefficient")


class SensitivityParameter(Struct, frozen=True):
    """A parameter whose sensitivities are integrated along a run.

    Attributes
    ----------
    name : str
    derivatives : tuple of ParameterDerivative
        Terms of the derivative of the equations of motion.
    q : (n,) array or None
        Derivative of the initial configuration, as a tangent vector.
    q_dot : (d,) array or None
        Derivative of the initial independent velocities.
    placements : tuple of ParameterDerivative
        Derivatives of the placements of joints and of reported points.
    assembled_at : int
        Coordinate whose stop the assembled configuration touches, if this parameter moves that stop and the
        configuration follows it in one direction only; -1 otherwise.
    slopes : mapping of str to arrays
        Derivatives of the model's numbers (`ParameterMap.derivative`).
    """

    name: str
    derivatives: tuple[ParameterDerivative, ...] = ()
    q: Array | None = None
    q_dot: Array | None = None
    placements: tuple[ParameterDerivative, ...] = ()
    assembled_at: int = -1
    slopes: Mapping[str, Array] = field(default_factory=dict)


# --- compiled terms ----------------------------------------------------------------------------------


def argument_directions(
    mechanism: Mechanism, parameters: Sequence[SensitivityParameter]
) -> tuple[dict[str, BoolArray], Array] | None:
    """Return the arguments that compiled terms must take and their derivatives with respect to the parameters.

    Returns
    -------
    dict of str to bool arrays
        Which numbers are arguments, as from `present`, including zeros that a parameter changes.
    (arguments, parameters) array
        Derivatives of the arguments.
    None if a parameter turns a joint or a direction, or if a body has no mass: those are not arguments.
    """
    numbers = model_numbers(mechanism)
    which = present(numbers)
    for x in parameters:
        if any(derivative.placement is not None and derivative.placement.revolute for derivative in x.derivatives):
            return None
        if any(
            derivative.kind == "inertia" and numbers["mass"][derivative.index] <= 0.0 for derivative in x.derivatives
        ):
            return None
        for key in numbers:
            if key in x.slopes:
                which[key] = which[key] | (x.slopes[key] != 0.0)
    zeros = {key: np.zeros_like(x) for key, x in numbers.items()}
    columns = [values({key: x.slopes.get(key, zeros[key]) for key in numbers}, which) for x in parameters]
    return which, np.array(columns).T


# --- in general --------------------------------------------------------------------------------------


def sensitivity_table(
    mechanism: Mechanism,
    parameters: Sequence[SensitivityParameter],
    directions: Array | None,
    *,
    at_equilibrium: bool,
    target: Array,
    controlled: bool,
) -> dict[str, Any]:
    """Return the table of the sensitivity equations for the core.

    Parameters
    ----------
    mechanism : Mechanism
    parameters : sequence of SensitivityParameter
    directions : (arguments, parameters) array or None
        From `argument_directions`; None without compiled terms that take the arguments.
    at_equilibrium : bool
        The motion starts at an equilibrium, which depends on the parameters.
    target : array
        q' at which a controller compensates the forces of this mechanism; empty if it compensates another model's.
    controlled : bool
        There is a controller, whose output may depend on every joint.
    """
    tree = mechanism.tree
    placements = _PlacementJoints(
        [derivative for x in parameters for derivative in x.derivatives if derivative.placement is not None]
    )
    model = pin.Model()
    model.gravity.linear = tree.model.gravity.linear
    tables = core_table(mechanism)
    closure, springs = tables["closure"], tables["springs"]
    joint_at = [0]
    placements.add_ends(model, 0, 0)
    for joint in range(1, tree.model.njoints):
        parent = placements.add(model, ("joint", joint), joint_at[tree.model.parents[joint]])
        at = model.addJoint(
            parent, tree.model.joints[joint], tree.model.jointPlacements[joint], tree.model.names[joint]
        )
        model.appendBodyToJoint(at, tree.model.inertias[joint], pin.SE3.Identity())
        joint_at.append(at)
        placements.add_ends(model, joint, at)  # Pinocchio requires that branches are added depth first
    for table in (closure, springs):
        for key in ("point_joint", "direction_joint"):
            table[key] = [joint_at[k] for k in table.get(key, [])]
    closure["log"] = [[*row[:3], *(joint_at[k] for k in row[3:])] for row in closure["log"]]
    for (placed, index), at in placements.ends.items():
        if placed in ("log_a", "log_b"):
            closure["log"][index][3 if placed == "log_a" else 4] = at
        elif placed == "direction":
            closure["direction_joint"][index] = at
        else:
            (closure if placed == "point" else springs)["point_joint"][index] = at
    joints = [(tree.model.joints[k], model.joints[joint_at[k]]) for k in range(1, tree.model.njoints)]
    real_q, real_v = np.zeros(tree.nq, np.intp), np.zeros(tree.n, np.intp)
    for real, extended in joints:
        real_q[real.idx_q : real.idx_q + real.nq] = np.arange(extended.idx_q, extended.idx_q + extended.nq)
        real_v[real.idx_v : real.idx_v + real.nv] = np.arange(extended.idx_v, extended.idx_v + extended.nv)
    armature = np.zeros(model.nv)
    armature[real_v] = tree.model.armature
    model.armature = armature
    closure["curve"] = [[row, int(real_v[k])] for row, k in closure["curve"]]
    closure["affine_matrix"] = _scatter_columns(closure["affine_matrix"], real_v, model.nv)
    for key in ("joint_stiffness", "joint_rest", "joint_damping", "constant"):
        springs[key] = _scatter_columns(springs[key], real_v, model.nv)

    def native_derivative(derivative: ParameterDerivative) -> tuple[_core.ParameterDerivativeKind, int, Array]:
        index = derivative.index
        if derivative.placement is not None:
            index = model.joints[placements.joint[id(derivative)]].idx_v
        elif derivative.kind == "inertia":
            index = joint_at[index]
        return _core.ParameterDerivativeKind[derivative.kind.upper()], index, derivative.values

    return {
        "model": packed(model),
        "q_index": Tree(model).q_index.tolist(),
        "real_q": real_q.tolist(),
        "real_v": real_v.tolist(),
        "closure": closure,
        "springs": springs,
        "fixed_q": mechanism.partition.q.tolist(),
        "at_equilibrium": at_equilibrium,
        "target": target,
        "transmission": np.asfortranarray(mechanism.motors.transmission),
        "parameters": [
            ([native_derivative(derivative) for derivative in x.derivatives], np.zeros(tree.n) if x.q is None else x.q,
             np.zeros(mechanism.d) if x.q_dot is None else x.q_dot, x.assembled_at)
            for x in parameters
        ],
        "part": [0] * tree.n if controlled else separate_parts(mechanism),
        "directions": np.zeros((0, len(parameters))) if directions is None else np.asfortranarray(directions),
    }  # fmt: skip


def separate_parts(mechanism: Mechanism) -> list[int]:
    """Return by coordinate the number of its part; no body, loop, coupling or spring connects two parts."""
    model, frames, spec = mechanism.tree.model, mechanism.frames, mechanism.spec
    part = list(range(model.njoints))  # by joint; being fixed to the world does not connect

    def connect(*joints: int) -> None:
        connected = {part[joint] for joint in joints if joint}
        for joint in range(1, model.njoints):
            if part[joint] in connected:
                part[joint] = min(connected)

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
        connect(*(model.getJointId(joint) for joint in coupled_joints(coupling)))
    number = {first_joint: k for k, first_joint in enumerate(dict.fromkeys(part[1:]))}
    by_coordinate = [0] * model.nv
    for joint in range(1, model.njoints):
        first, count = model.joints[joint].idx_v, model.joints[joint].nv
        by_coordinate[first : first + count] = [number[part[joint]]] * count
    return by_coordinate


class _PlacementJoints:
    """Add the locked joints of placement parameters to a model: a chain if several parameters place one object."""

    def __init__(self, derivatives: Sequence[ParameterDerivative]) -> None:
        self._derivatives = derivatives
        self.joint: dict[int, int] = {}  # by id of the derivative
        self.ends: dict[tuple[PlacedKind, int], int] = {}  # last joint of a chain, by placed object; without joints

    def add(self, model: Any, placed: tuple[PlacedKind, int], parent: int) -> int:
        """Add the joints of one placed object; return the joint that carries it."""
        for derivative in self._derivatives:
            placement = derivative.placement
            assert placement is not None
            if (placement.placed, derivative.index) == placed:
                kind = pin.JointModelRevoluteUnaligned if placement.revolute else pin.JointModelPrismaticUnaligned
                name = f"lock {len(self.joint)}"
                parent = int(model.addJoint(parent, kind(np.array(placement.axis)), pin.SE3.Identity(), name))
                self.joint[id(derivative)] = parent
        return parent

    def add_ends(self, model: Any, joint: int, at: int) -> None:
        """Add the joints of the points, directions and spring ends that one joint carries."""
        for derivative in self._derivatives:
            placement = derivative.placement
            assert placement is not None
            placed = (placement.placed, derivative.index)
            if placement.placed != "joint" and placement.carrier == joint and placed not in self.ends:
                self.ends[placed] = self.add(model, placed, at)


def _scatter_columns(table: Array, columns: Any, count: int) -> Array:
    """Return a table of `count` columns with a narrower table's at the indices `columns` and zeros elsewhere."""
    wide = np.zeros((*np.shape(table)[:-1], count))
    wide[..., columns] = table
    return wide
