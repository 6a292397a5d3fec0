"""MuJoCo's actuators: motors with their gears and limits, and constant forces. Gains are MuJoCo's own controllers'."""

from __future__ import annotations

import math

from ckc_pin.formats.draft import number, some
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.tree import MjcfTree
from ckc_pin.mechanism.spec import ForceSpec, MotorSpec

__all__ = ["Actuators", "moved_joints"]


class Actuators:
    """The actuators of a model.

    Attributes
    ----------
    joints : list of str
        What has a motor.
    motors : list of MotorSpec
        A motor a joint, where one has a gear or a limit.
    forces : list of (ForceSpec, comment)
    left_out : list of str
    """

    def __init__(self, compiled: Compiled, tree: MjcfTree) -> None:
        self.joints: list[str] = []
        motors: list[MotorSpec] = []
        self.forces: list[tuple[ForceSpec, str]] = []
        self.left_out: list[str] = []
        controlled = []
        for k in range(compiled.model.nactuator):
            joint = _joint_of(compiled, k)
            name = compiled.name("actuator", k)
            if joint is None or joint not in tree.ref:
                through = "a joint of several freedoms" if joint is not None else _target(compiled, k)
                rotor = ", its armature too" if joint is None and compiled.model.actuator_armature[k] else ""
                self.left_out.append(f"actuator {name} on {through}{rotor}".replace("  ", " "))
            elif value := _constant(compiled, k):
                spec = ForceSpec(joint=compiled.joints[joint], value=number(value))
                self.forces.append((spec, f"actuator {name}, which takes no control".replace("  ", " ")))
            else:
                if compiled.joints[joint] not in self.joints:
                    self.joints.append(compiled.joints[joint])
                    motors.append(_motor(compiled, k, compiled.joints[joint]))
                controlled += [] if _is_plain_motor(compiled, k) else [compiled.joints[joint]]
        names = {motor.name for motor in motors}
        plain = len(names) < len(motors) or all(motor.ratio == 1.0 and motor.torque_limit is None for motor in motors)
        self.motors = [] if plain else motors
        if controlled:
            said = "what actuators do with their control, their gains and curves; their joints have motors"
            self.left_out.append(f"{said}: {some(list(dict.fromkeys(controlled)))}")


def moved_joints(compiled: Compiled) -> set[int]:
    """Return the joints that actuators are on."""
    joints = (_joint_of(compiled, k) for k in range(compiled.model.nactuator))
    return {joint for joint in joints if joint is not None}


def _joint_of(compiled: Compiled, k: int) -> int | None:
    model, kinds = compiled.model, compiled.mujoco.mjtTrn
    through = int(model.actuator_trntype[k]) in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT)
    return int(model.actuator_trnid[k, 0]) if through else None


def _target(compiled: Compiled, k: int) -> str:
    """Say what an actuator is on that is no joint."""
    model, kinds = compiled.model, compiled.mujoco.mjtTrn
    target = {
        int(kinds.mjTRN_TENDON): "tendon",
        int(kinds.mjTRN_SITE): "site",
        int(kinds.mjTRN_SLIDERCRANK): "site",
        int(kinds.mjTRN_BODY): "body",
    }
    what = target.get(int(model.actuator_trntype[k]), "")
    return f"{what} {compiled.name(what, model.actuator_trnid[k, 0])}" if what else "no joint"


def _constant(compiled: Compiled, k: int) -> float:
    """Return the force of an actuator that no control changes, as `ckc export` writes one; 0 for any other."""
    model, mujoco = compiled.model, compiled.mujoco
    controlled = int(model.actuator_gaintype[k]) != mujoco.mjtGain.mjGAIN_FIXED or model.actuator_gainprm[k].any()
    bias = model.actuator_biasprm[k]
    if controlled or int(model.actuator_biastype[k]) != mujoco.mjtBias.mjBIAS_AFFINE or bias[1:].any():
        return 0.0
    return float(model.actuator_gear[k, 0] * bias[0])


def _motor(compiled: Compiled, k: int, joint: str) -> MotorSpec:
    """Return an actuator on a joint as a motor; its armature is with the joint's already."""
    model = compiled.model
    limit = math.inf
    gain = abs(float(model.actuator_gainprm[k, 0]))
    for limited, bounds, by in (
        (model.actuator_forcelimited[k], model.actuator_forcerange[k], 1.0),
        (model.actuator_ctrllimited[k] and _is_plain_motor(compiled, k), model.actuator_ctrlrange[k], gain),
    ):
        if limited and bounds[0] < 0 < bounds[1]:
            limit = min(limit, by * float(min(-bounds[0], bounds[1])))
    gear = float(model.actuator_gear[k, 0])
    return MotorSpec(
        name=compiled.name("actuator", k) or joint,
        joint=joint,
        ratio=number(gear) if gear else 1.0,
        torque_limit=number(limit) if math.isfinite(limit) else None,
    )


def _is_plain_motor(compiled: Compiled, k: int) -> bool:
    """Whether an actuator's control is its force, but for a factor."""
    model, mujoco = compiled.model, compiled.mujoco
    kinds = [int(kind[k]) for kind in (model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)]
    plain = [mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE]
    return kinds == [int(kind) for kind in plain] and bool(model.actuator_gear[k, 0])
