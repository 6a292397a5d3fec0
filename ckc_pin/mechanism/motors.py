"""Motors: the joints that each of them drives, gears, torque and speed limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.validation import is_number, suggest_name
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.spec import MechanismSpec, MotorSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Motors", "motors_of", "torque_limits"]


class Motors:
    """Motors of a mechanism. Shaft rates are ``theta_dot = transmission @ v_tree``.

    Gears have no losses, so the motor torques tau act on the tree as u' = transmission^T tau.

    Parameters
    ----------
    names : sequence of str
    transmission : (m, n) array
        Shaft rates by joint rates: the gear ratios.
    torque_limit : (2, m) array
        Lower and upper limits at the shaft, N m or N; infinite if there is no limit.
    speed_limit : (m,) array
        At the shaft, rad/s or m/s; infinite if there is no limit.
    key : str
        Key of the mechanism file that lists them, for messages.

    Raises
    ------
    MechanismError
        Two motors have the same name.
    """

    def __init__(
        self, names: Sequence[str], transmission: Array, torque_limit: Array, speed_limit: Array, key: str = "motor"
    ) -> None:
        self.names, self.transmission, self.key = tuple(names), transmission, key
        self.torque_limit, self.speed_limit = torque_limit, speed_limit
        duplicate = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if duplicate is not None:
            raise MechanismError(
                f"actuated: a joint is named twice in {list(names)}"
                if key == "actuated"
                else f"motor: two motors are called {duplicate!r}; give them different names"
            )

    @classmethod
    def on_joints(cls, tree: Tree, joints: Sequence[str]) -> Motors:
        """Return one motor for each joint, without gear, limits or rotor inertia.

        Raises
        ------
        InputError, MechanismError
            An unknown joint, a coordinate of a free root, or a joint named twice.
        """
        at = tree.indices(tuple(joints), "actuated")
        of_root = [name for name in joints if name in tree.free_coordinates]
        if of_root:
            raise MechanismError(f"actuated: {of_root[0]!r} belongs to a free root, which has no motor")
        unlimited = np.full(len(at), np.inf)
        return cls(joints, np.eye(tree.n)[at], np.array([-unlimited, unlimited]), unlimited, "actuated")

    def with_joints(self, tree: Tree, joints: Sequence[str]) -> Motors:
        """Return these motors and one more, without gear and limits, for each joint that none of them drives alone."""
        missing = [joint for joint in joints if self.motor_on(tree.index[joint]) is None]
        if not missing:
            return self
        others = Motors.on_joints(tree, missing)
        return Motors(
            (*self.names, *others.names),
            np.vstack([self.transmission, others.transmission]),
            np.concatenate([self.torque_limit, others.torque_limit], axis=1),
            np.concatenate([self.speed_limit, others.speed_limit]),
            self.key,
        )

    def motor_on(self, coordinate: int) -> int | None:
        """Return the motor that drives this coordinate and no other one, or None."""
        driven = self.transmission != 0.0
        alone = np.flatnonzero(driven[:, coordinate] & (driven.sum(axis=1) == 1))
        return int(alone[0]) if len(alone) else None

    def driven_coordinates(self) -> IntArray:
        """Return the coordinates that a motor drives, in the order of the motors."""
        driven = np.flatnonzero(self.transmission.any(axis=0))
        if not len(driven):  # argmax needs a motor
            return driven
        return driven[np.argsort(np.argmax(self.transmission[:, driven] != 0, axis=0), kind="stable")]

    def force(self, tau: Array) -> Array:
        """Return the generalized force u' of motor torques on the tree, shape (n,)."""
        return self.transmission.T @ tau

    def vector(self, values: Mapping[str, Any], what: str, fill: float | None = None) -> Array:
        """Convert a table by motor to a vector, shape (m,).

        Raises
        ------
        InputError
            An unknown motor, a missing one (unless `fill` is given), or a value that is not a number.
        """
        unknown = next((name for name in values if name not in self.names), None)
        if unknown is not None:
            nearest = suggest_name(unknown, self.names)
            raise InputError(f"{what}: no motor {unknown!r}; there are {', '.join(self.names) or 'none'}{nearest}")
        missing = [name for name in self.names if name not in values]
        if missing and fill is None:
            raise InputError(f"{what}: {', '.join(missing)} missing; expected {', '.join(self.names)}")
        try:
            if all(map(is_number, values.values())):
                return np.array([float(values.get(name, fill)) for name in self.names])
        except OverflowError:  # an integer that is too large for a float
            pass
        raise InputError(f"{what}: expected a table of numbers by motor, got {dict(values)!r:.80}")


def motors_of(spec: MechanismSpec, tree: Tree) -> Motors | None:
    """Return the motors of a mechanism file, or None if it names none. Rotor inertias are added to the tree's model.

    Raises
    ------
    InputError, MechanismError
        Both `actuated` and `motor` are given, a motor has no joint, a gear ratio is zero, or an inertia or a torque
        limit is not possible.
    """
    if spec.actuated is not None and spec.motor:
        raise MechanismError("actuated, motor: give one of them; actuated stands for motors without a gear")
    if spec.actuated is not None:
        return Motors.on_joints(tree, spec.actuated)
    if not spec.motor:
        return None
    transmission, armature = np.zeros((len(spec.motor), tree.n)), np.array(tree.model.armature)
    names, rotors = [], np.zeros((tree.n, tree.n))
    for k, motor in enumerate(spec.motor):
        names.append(_motor_name(motor, k))
        where = f"motor {names[k]!r}"
        for joint, share in _driven_joints(motor, where).items():
            transmission[k, tree.joint_index(joint, where)] = motor.ratio * share
        if not transmission[k].any():
            raise MechanismError(f"{where}: its gear turns no joint; give a ratio other than 0")
        if motor.rotor_inertia:
            with np.errstate(over="ignore"):
                if np.count_nonzero(transmission[k]) > 1:
                    rotors += motor.rotor_inertia * np.outer(transmission[k], transmission[k])
                else:
                    armature += transmission[k] ** 2 * motor.rotor_inertia
            if not np.all(np.isfinite(armature)) or not np.all(np.isfinite(rotors)):
                raise MechanismError(
                    f"{where}: ratio = {motor.ratio:g} with rotor_inertia = {motor.rotor_inertia:g} is too large: the "
                    "inertia at the joint is not finite"
                )
    tree.model.armature, tree.rotors = armature, rotors
    limits = [
        torque_limits(m.torque_limit, f"motor {name!r}: torque_limit")
        for name, m in zip(names, spec.motor, strict=True)
    ]
    speeds = np.array([m.speed_limit or np.inf for m in spec.motor])
    return Motors(names, transmission, np.array(limits).T, speeds)


def torque_limits(limit: float | Sequence[float] | None, where: str) -> tuple[float, float]:
    """Return the lower and the upper limit of a torque, which are infinite if there is none.

    Parameters
    ----------
    limit : float or pair of float, optional
        Largest |tau|, or both limits.
    where : str
        Prefix of the error message.

    Raises
    ------
    InputError
        Zero is not within the limits, or both limits are zero.
    """
    if limit is None or isinstance(limit, float | int):
        size = np.inf if limit is None else float(limit)
        return -size, size
    lower, upper = limit
    if not lower <= 0.0 <= upper or lower == upper:
        raise InputError(f"{where}: expected a lower limit of at most 0 and an upper one of at least 0, "
                             f"got [{lower:g}, {upper:g}]")  # fmt: skip
    return lower, upper


def _motor_name(motor: MotorSpec, k: int) -> str:
    if motor.name is None and motor.joint is None:
        raise MechanismError(f"motor {k + 1}: give it a joint, or a name and joints")
    return str(motor.name or motor.joint)


def _driven_joints(motor: MotorSpec, where: str) -> dict[str, float]:
    if (motor.joint is None) == (not motor.joints):
        raise MechanismError(f"{where}: give either joint, or joints, a table of numbers by joint")
    return motor.joints if motor.joint is None else {motor.joint: 1.0}
