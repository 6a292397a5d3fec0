"""Joints of UsdPhysics, with their limits, and with what PhysX and MuJoCo add to them.

A joint has slides along and hinges about the axes of its frame, slides first, each in the order x, y, z. A generic
joint leaves free what no UsdPhysicsLimitAPI locks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import from_axis_angle, round_number
from ckc_pin.formats.robot import JointAxis, JointKind, JointLimits
from ckc_pin.formats.usd.stage import Stage

__all__ = ["DISTANCE", "JointFreedoms", "angles_of"]

DISTANCE = "PhysicsDistanceJoint"
DIRECTIONS = dict(zip("XYZ", np.eye(3), strict=True))
FREEDOMS = {  # by type; {} is the joint's axis
    **{"PhysicsFixedJoint": "", "PhysicsRevoluteJoint": "rot{}", "PhysicsPrismaticJoint": "trans{}"},
    **{"PhysicsSphericalJoint": "rotX rotY rotZ", "PhysicsJoint": "transX transY transZ rotX rotY rotZ"},
}
KINDS: dict[tuple[int, int], JointKind] = {  # by the numbers of slides and hinges; otherwise a row of them
    **{(0, 0): "fixed", (0, 1): "revolute", (1, 0): "prismatic", (0, 2): "universal", (0, 3): "ball"},
    **{(1, 1): "cylindrical", (2, 1): "planar", (3, 3): "floating"},
}
PROPERTIES = (  # of an axis: attribute, in which {} is the freedom, and its unit
    *(("armature", name, "inertia") for name in ("physxJoint:armature", "physxJointAxis:{}:armature", "mjc:armature")),
    *(("friction", name, "force") for name in ("physxJointAxis:{}:dynamicFrictionEffort", "mjc:frictionloss")),
    ("damping", "physxJointAxis:{}:viscousFrictionCoefficient", "force per rate"),
    ("damping", "mjc:damping", "inertia"),
    *(("speed", name, "rate") for name in ("physxJoint:maxJointVelocity", "physxJointAxis:{}:maxJointVelocity")),
)


class JointFreedoms:
    """The freedoms of a joint: their names, axes and kind, and the displacement at which equal limits lock others."""

    def __init__(self, stage: Stage, prim: Any) -> None:
        self.stage, self.prim, self.shift, self.turn = stage, prim, pin.SE3.Identity(), pin.SE3.Identity()
        type_name, where = str(prim.GetTypeName()), stage.where(prim)
        letter = str(stage.value(prim, "physics:axis") or "X")
        if type_name not in FREEDOMS:
            choices = ", ".join((*FREEDOMS, DISTANCE))
            raise MechanismError(f"{where}: unsupported joint type {type_name!r}; expected one of {choices}")
        if letter not in DIRECTIONS:
            raise InputError(f"{where}: physics:axis = {letter!r}; expected X, Y or Z")
        self.is_generic = type_name == "PhysicsJoint"
        self.declared = FREEDOMS[type_name].format(letter).split()
        self.names = [name for name in self.declared if not self._is_locked(name)]
        slides, hinges = ([name[-1] for name in self.names if name.startswith(t)] for t in ("trans", "rot"))
        kind = KINDS.get((len(slides), len(hinges)), "hinges")
        is_aligned = {"cylindrical": slides == hinges, "planar": not set(hinges) & set(slides)}
        self.kind: JointKind = kind if is_aligned.get(kind, True) else "hinges"
        if hinges and not self.turn.isIdentity(0.0):
            raise MechanismError(f"{where}: an angle is locked at another value than 0 beside free angles; expected 0")
        self.axes = [self._axis(name) for name in self.names]

    def unit(self, name: str, of: str) -> float:
        """Return the SI unit of a freedom's rate, force, inertia, or force per rate."""
        length, slides = self.stage.length, name.startswith("trans")
        inertia = self.stage.mass * (1.0 if slides else length**2)
        rate, force = (length, inertia * length) if slides else (math.radians(1.0), inertia)
        return {"rate": rate, "force": force, "inertia": inertia, "force per rate": force / rate}[of]

    def find(self, attribute: str, name: str, default: float) -> float:
        """Return an attribute of a freedom, in which {} is the freedom as an instance of a schema."""
        keys = dict.fromkeys(attribute.format(instance) for instance in self._instances(name))
        values = [self.stage.number(self.prim, key, default, finite=False) for key in keys]
        return next((x for x in values if x != default), default)

    def has_drive(self, name: str) -> bool:
        """Whether a drive acts on a freedom."""
        return any(f"PhysicsDriveAPI:{key}" in self.prim.GetAppliedSchemas() for key in self._instances(name))

    def _instances(self, name: str) -> Sequence[str]:
        return (name,) if self.is_generic else (name, "linear" if name.startswith("trans") else "angular")

    def _limits(self, name: str) -> tuple[float, float]:
        keys = ("limit:{}:physics:low", "limit:{}:physics:high")
        keys = keys if len(self.declared) != 1 else ("physics:lowerLimit", "physics:upperLimit")
        low, high = self.find(keys[0], name, -math.inf), self.find(keys[1], name, math.inf)
        return low * self.unit(name, "rate"), high * self.unit(name, "rate")

    def _is_locked(self, name: str) -> bool:
        (low, high), direction = self._limits(name), DIRECTIONS[name[-1]]
        if low == high and name.startswith("trans"):
            self.shift = self.shift * pin.SE3(np.eye(3), low * direction)
        elif low == high:
            self.turn = self.turn * pin.SE3(from_axis_angle(direction, low), np.zeros(3))
        return low == high or (self.is_generic and low > high)

    def _axis(self, name: str) -> JointAxis:
        low, high = (round_number(x) if math.isfinite(x) else None for x in self._limits(name))
        values = {key: 0.0 for key, _, _ in PROPERTIES}
        for key, attribute, unit in PROPERTIES:
            value = self.find(attribute, name, 0.0)
            values[key] = value * self.unit(name, unit) if value and math.isfinite(value) else values[key]
        axis = JointAxis(DIRECTIONS[name[-1]], name.startswith("trans"), suffix=f"_{name}")
        axis.limits = JointLimits(low, high, velocity=values["speed"])
        axis.armature, axis.friction, axis.damping = values["armature"], values["friction"], values["damping"]
        return axis


def angles_of(rotation: Array, axes: Sequence[Array]) -> list[float]:
    """Return the angles of up to three hinges in a row, about coordinate axes in the order x, y, z."""
    if not axes:
        return []
    first, *others = axes
    if not others:
        quaternion = pin.Quaternion(rotation)
        return [2 * math.atan2(float(quaternion.vec() @ first), quaternion.w)]
    last = rotation @ others[-1]  # does not turn with its own hinge
    if len(others) == 1:
        angle = math.atan2(float(np.cross(first, others[0]) @ last), float(others[0] @ last))
    else:
        angle = math.atan2(-float(others[0] @ last), float(others[1] @ last))
    return [angle, *angles_of(from_axis_angle(first, angle).T @ rotation, others)]
