"""Derivatives of the equations of motion with respect to parameters, from the derivative of the parameter map.

A length or an angle becomes the coordinate of a locked joint where something is placed, so that its derivatives are
those along any other coordinate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import list_loop_frames
from ckc_pin.mechanism.parameters import split_name
from ckc_pin.mechanism.rows import RelativeLog
from ckc_pin.native.sensitivity_tables import ParameterDerivative, PlacedKind, PlacementJoint

__all__ = ["find_parameter_derivatives"]

BY_INDEX = (
    "length", "constant", "joint_stiffness", "joint_rest", "joint_damping", "stiffness", "rest_length", "damping",
    "friction", "restitution", "lower", "upper",
)  # fmt: skip


def find_parameter_derivatives(
    mechanism: Mechanism, actuation: Actuation, name: str, slopes: Mapping[str, Array]
) -> tuple[ParameterDerivative, ...]:
    """Return the partial derivatives through which a parameter acts; none if the motion does not depend on it.

    Parameters
    ----------
    mechanism : Mechanism
    actuation : Actuation
    name : str
        A single parameter.
    slopes : mapping of str to arrays
        Derivatives of the model's numbers, as `ParameterMap.derivative` returns them.

    Raises
    ------
    InputError
        A parameter with respect to which the motion has no derivative.
    """
    if name.startswith("motor."):
        _require_motor_derivative(mechanism, actuation, name)
    return (
        *_placements(mechanism, slopes),
        *_bodies(slopes),
        *_entries(slopes),
        *_motors(mechanism, actuation, slopes),
    )


def _placements(mechanism: Mechanism, slopes: Mapping[str, Array]) -> Iterator[ParameterDerivative]:
    """Derivatives of the placements of joints, loop frames, spring ends and reported points."""
    model, closure, springs = mechanism.tree.model, mechanism.closure, mechanism.springs
    zeros = np.zeros((model.njoints, 3, 3))
    turned, moved = slopes.get("rotation", zeros), slopes.get("offset", zeros[:, 0])
    for joint in np.flatnonzero(turned.any(axis=(1, 2)) | moved.any(axis=1)).tolist():
        placement = model.jointPlacements[joint]
        turn = _angular(turned[joint], placement.rotation)
        slide = moved[joint] - np.cross(turn, placement.translation)  # of the carrier's origin
        yield from _placement_joints(model.parents[joint], "joint", joint, turn, slide)
    carriers: dict[str, tuple[PlacedKind, list[int]]] = {
        "point": ("point", list(closure.anchors.point_joint)),
        "end": ("spring", list(springs.anchors.point_joint)),
        "reported": ("reported", [frame.joint for frame in mechanism.points.values()]),
    }
    for key, (place, joints) in carriers.items():
        for k, slide in enumerate(slopes.get(key, ())):
            yield from _placement_joints(joints[k], place, k, np.zeros(3), slide)
    for k, slope in enumerate(slopes.get("point_rotation", ())):
        end, loop = divmod(k, len(mechanism.spec.loop))
        frame = mechanism.frames.find(list_loop_frames(mechanism.spec)[k][1], "parameters")
        turn = _angular(slope, frame.rotation)
        for place, index in _directions(mechanism, mechanism.spec.loop[loop].name, end):
            yield from _placement_joints(frame.joint, place, index, turn, np.zeros(3))


def _angular(slope: Array, rotation: Array) -> Array:
    """Return the angular velocity of a rotation that changes with this slope, in the carrier's axes."""
    return np.asarray(pin.unSkew(slope @ rotation.T))


def _placement_joints(
    carrier: int, place: PlacedKind, index: int, turn: Array, slide: Array
) -> Iterator[ParameterDerivative]:
    for twist, turns in ((turn, True), (slide, False)):
        size = float(np.linalg.norm(twist))
        if size:
            yield ParameterDerivative(
                "placement", index, np.array([size]), PlacementJoint(place, carrier, twist / size, revolute=turns)
            )


def _directions(mechanism: Mechanism, loop: str, end: int) -> Iterator[tuple[PlacedKind, int]]:
    """Directions and relative rotations that turn with a loop's frame."""
    closure, label = mechanism.closure, ("frame_a", "frame_b")[end]
    yield from (("direction", k) for k, frame in enumerate(closure.direction_frames) if frame == (loop, label))
    for group in closure.groups:
        if isinstance(group, RelativeLog):
            loops = [closure.names[out][0] for out in group.out[::3]]
            yield from (("log_b" if end else "log_a", k) for k, name in enumerate(loops) if name == loop)


def _bodies(slopes: Mapping[str, Array]) -> Iterator[ParameterDerivative]:
    """Derivatives of bodies' mass, first moment and inertia about the joint's origin."""
    keys = [key for key in ("mass", "moment", "origin_inertia") if key in slopes]
    for joint in sorted({int(k) for key in keys for k in np.argwhere(slopes[key])[:, 0]}):
        mass = slopes["mass"][joint] if "mass" in slopes else 0.0
        moment = slopes["moment"][joint] if "moment" in slopes else np.zeros(3)
        inertia = slopes["origin_inertia"][joint] if "origin_inertia" in slopes else np.zeros((3, 3))
        yield ParameterDerivative("inertia", joint, np.concatenate([[mass], moment, inertia[np.triu_indices(3)]]))


def _entries(slopes: Mapping[str, Array]) -> Iterator[ParameterDerivative]:
    """Derivatives of numbers that appear in the equations as in the file."""
    if "gravity" in slopes:
        yield ParameterDerivative("gravity", values=slopes["gravity"])
    for key in BY_INDEX:
        yield from (ParameterDerivative(key, int(k), np.ones(1)) for k in np.flatnonzero(slopes.get(key, ())))
    yield from (ParameterDerivative("offset", int(k)) for k in np.flatnonzero(slopes.get("affine_offset", ())))
    coefficients = slopes.get("affine", np.zeros((0, 0)))
    for row, k in np.argwhere(coefficients):
        yield ParameterDerivative("coefficient", int(row), np.array([k, coefficients[row, k]], dtype=float))
    for k in np.flatnonzero(slopes.get("armature", ())):
        yield ParameterDerivative("armature", int(k), slopes["armature"][k : k + 1])
    rotors = slopes.get("rotors", np.zeros((0, 0)))
    rotors = rotors + np.triu(rotors, 1).T
    yield from (ParameterDerivative("rotors", int(k), rotors[k]) for k in np.flatnonzero(rotors.any(axis=1)))


def _motors(mechanism: Mechanism, actuation: Actuation, slopes: Mapping[str, Array]) -> Iterator[ParameterDerivative]:
    """A gear acts where a motor's torque is what is given, a limit while it is reached."""
    for number in {int(k) for k in np.argwhere(slopes.get("transmission", np.zeros((0, 0))))[:, 0]}:
        yield ParameterDerivative("gear", number, slopes["transmission"][number])
    limits = np.where(actuation.limit == mechanism.motors.torque_limit, slopes.get("torque_limit", 0.0), 0.0)
    for k in np.flatnonzero(limits.any(axis=0)):
        yield ParameterDerivative("torque_limit", int(k), limits[:, k])


def _require_motor_derivative(mechanism: Mechanism, actuation: Actuation, name: str) -> None:
    _, motor, key = split_name(name)
    number = mechanism.motors.names.index(motor)
    limits = zip(mechanism.motors.torque_limit[:, number], actuation.scene_limit[:, number], strict=True)
    sides = {"torque_limit.lower": [0], "torque_limit.upper": [1], "torque_limit": [0, 1]}.get(key, [])
    if any(of_motor == of_scene for side, (of_motor, of_scene) in enumerate(limits) if side in sides):
        raise InputError(
            f"sensitivities: {name}: the controller's torque_limit has the same value, so the derivative exists on "
            "one side only; give only one of the two limits"
        )
