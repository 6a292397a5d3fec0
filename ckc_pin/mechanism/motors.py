"""Motors: which joints each of them transmission, through which gear, and what it can do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import is_number
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.spec import MechanismSpec, MotorSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Motors", "motors_of"]


class Motors:
    """The motors of a mechanism: with theta the angles of their shafts, theta_dot = transmission v'.

    Power is the same on both sides of a gear, so a motor's own torque tau acts on the tree as u' = transmission^T tau.

    Parameters
    ----------
    names : sequence of str
    transmission : (m, n) array
        A motor's rate by the joints' rates: its gear.
    torque_limit, speed_limit : (m,) array
        Of the motor itself, N m or N, rad/s or m/s; infinite where there is none.
    key : str
        What the mechanism's file calls them.

    Raises
    ------
    MechanismError
        Two motors of one name.
    """

    def __init__(
        self, names: Sequence[str], transmission: Array, torque_limit: Array, speed_limit: Array, key: str = "motor"
    ) -> None:
        self.names, self.transmission, self.key = tuple(names), transmission, key
        self.torque_limit, self.speed_limit = torque_limit, speed_limit
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise MechanismError(
                f"actuated: a joint is named twice in {list(names)}"
                if key == "actuated"
                else f"motor: two motors are called {twice!r}; give each a name of its own"
            )

    @classmethod
    def on_joints(cls, tree: Tree, joints: Sequence[str]) -> Motors:
        """Return a motor for each joint, without gear, limits or a rotor's inertia.

        Raises
        ------
        InputError, MechanismError
            No such joint, one of a free root, one named twice.
        """
        at = tree.indices(tuple(joints), "actuated")
        rooted = [name for name in joints if name in tree.free_coordinates]
        if rooted:
            raise MechanismError(f"actuated: {rooted[0]!r} belongs to a free root, which has no motor")
        without = np.full(len(at), np.inf)
        return cls(joints, np.eye(tree.n)[at], without, without, "actuated")

    def force(self, tau: Array) -> Array:
        """Return what torques do to the tree, u' of shape (n,)."""
        return self.transmission.T @ tau

    def vector(self, values: Mapping[str, Any], what: str, fill: float | None = None) -> Array:
        """Turn a table by motor into a vector, shape (m,).

        Raises
        ------
        InputError
            A name that is no motor's, a missing one unless `fill` is given, a value that is no number.
        """
        unknown = next((name for name in values if name not in self.names), None)
        if unknown is not None:
            raise InputError(f"{what}: {unknown!r} is no actuator; there are {', '.join(self.names) or 'none'}")
        missing = [name for name in self.names if name not in values]
        if missing and fill is None:
            raise InputError(f"{what}: {', '.join(missing)} missing; expected {', '.join(self.names)}")
        try:
            if all(map(is_number, values.values())):
                return np.array([float(values.get(name, fill)) for name in self.names])
        except OverflowError:  # an integer of any size
            pass
        raise InputError(f"{what}: {dict(values)!r:.80} is no table of numbers by actuator")


def motors_of(spec: MechanismSpec, tree: Tree) -> Motors | None:
    """Return the motors of a mechanism's file, None where it names none; rotors go into the tree's model.

    Raises
    ------
    InputError, MechanismError
        Both ways of naming them, a motor on no joint, a gear that does not turn, a rotor on several joints.
    """
    if spec.actuated is not None and spec.motor:
        raise MechanismError("actuated, motor: give one of them; actuated is short for motors without a gear")
    if spec.actuated is not None:
        return Motors.on_joints(tree, spec.actuated)
    if not spec.motor:
        return None
    transmission, armature = np.zeros((len(spec.motor), tree.n)), np.array(tree.model.armature)
    names = []
    for k, motor in enumerate(spec.motor):
        names.append(_name(motor, k))
        where = f"motor {names[k]!r}"
        for joint, share in _joints(motor, where).items():
            transmission[k, tree.joint_index(joint, where)] = motor.ratio * share
        if not transmission[k].any():
            raise MechanismError(f"{where}: its gear turns no joint; give a ratio other than 0")
        if motor.rotor_inertia and np.count_nonzero(transmission[k]) > 1:
            raise MechanismError(
                f"{where}: rotor_inertia goes with a motor on one joint; on several it would couple their inertias. "
                "Leave it out, or give the joints an armature"
            )
        if motor.rotor_inertia:
            with np.errstate(over="ignore"):
                armature += transmission[k] ** 2 * motor.rotor_inertia
            if not np.all(np.isfinite(armature)):
                raise MechanismError(
                    f"{where}: ratio = {motor.ratio:g} with rotor_inertia = {motor.rotor_inertia:g} is too large: what "
                    "they make of the joint's inertia is no finite number"
                )
    tree.model.armature = armature
    limits = np.array([(m.torque_limit or np.inf, m.speed_limit or np.inf) for m in spec.motor])
    return Motors(names, transmission, limits[:, 0], limits[:, 1])


def _name(motor: MotorSpec, k: int) -> str:
    if motor.name is None and motor.joint is None:
        raise MechanismError(f"motor {k + 1}: give it a joint, or a name and joints")
    return str(motor.name or motor.joint)


def _joints(motor: MotorSpec, where: str) -> dict[str, float]:
    if (motor.joint is None) == (not motor.joints):
        raise MechanismError(f"{where}: give either joint, or joints, a table of numbers by joint")
    return motor.joints if motor.joint is None else {motor.joint: 1.0}
