"""Read a MuJoCo model into a robot: tree, loops, springs, motors and points.

Actuators become motors with their gears and limits, or constant forces. Gains are left out, because they belong to
MuJoCo's own controllers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin

from ckc_pin.formats.conversion import (
    choose_name,
    list_names,
    make_frame,
    make_unique,
    round_number,
    round_vector,
)
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.constraints import Equalities, Tendons
from ckc_pin.formats.mjcf.document import Document
from ckc_pin.formats.mjcf.tree import MjcfTree
from ckc_pin.formats.robot import Robot
from ckc_pin.mechanism.spec import ForceSpec, MotorSpec, PointSpec

__all__ = ["read_mjcf"]


def read_mjcf(text: str, path: Path) -> Robot:
    """Read a MuJoCo model.

    Parameters
    ----------
    text : str
    path : Path
        File of the text. Files that the model names are resolved relative to it.

    Raises
    ------
    InputError
        The text is not a valid MuJoCo model (the message names the element), or MuJoCo is not installed.
    """
    document = Document.read(text, path)
    compiled = Compiled.of(document)
    model = compiled.model
    tendons = Tendons(compiled)
    is_joint_equality = model.eq_type == int(compiled.mujoco.mjtEq.mjEQ_JOINT)
    in_equalities = {int(joint) for ids in (model.eq_obj1id, model.eq_obj2id) for joint in ids[is_joint_equality]}
    tree = MjcfTree(compiled, in_equalities | _actuated_joints(compiled) | tendons.used_joints)
    equalities = Equalities(compiled, tree, tendons)
    springs, tendon_notes = tendons.springs(tree)
    actuators = _Actuators(compiled, tree, tendons)
    name = choose_name(path, document.root.get("model", ""))
    has_medium = any(model.opt.wind) or model.opt.density or model.opt.viscosity
    disabled = _disabled_features(compiled)
    return Robot(
        name=name,
        origin=f"{path.name}, a MuJoCo model",
        source=str(path),
        links=tree.links,
        joints=tree.joints,
        loops=equalities.loops,
        couplings=equalities.couplings,
        springs=springs,
        forces=actuators.forces,
        motors=[(motor, "") for motor in actuators.motors],
        points=_free_sites(compiled, tree),
        actuated=actuators.joints or None,
        gravity=round_vector((0.0, 0.0, 0.0) if "gravity" in disabled else model.opt.gravity),
        q_guess=tree.q_guess,
        key_frames=tree.key_frames,
        guessed=tree.guessed
        + equalities.guessed
        + actuators.guessed
        + [f"MuJoCo warns: {warning}" for warning in compiled.warnings],
        left_out=[
            *tree.left_out,
            *equalities.left_out,
            *tendon_notes,
            *actuators.left_out,
            *document.left_out,
            *(["forces of the medium (wind, density, viscosity)"] if has_medium else []),
            *(
                f"the model's flag that disables {feature}: they act here"
                for feature in disabled
                if feature != "gravity"
            ),
        ],
    )


def _disabled_features(compiled: Compiled) -> list[str]:
    """Return the features of a mechanism that flags of the model disable."""
    bits = compiled.mujoco.mjtDisableBit
    flags = {
        "gravity": bits.mjDSBL_GRAVITY,
        "springs": bits.mjDSBL_SPRING,
        "dampers": bits.mjDSBL_DAMPER,
        "equality constraints": bits.mjDSBL_EQUALITY | bits.mjDSBL_CONSTRAINT,
        "dry friction": bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT,
        "ranges of joints": bits.mjDSBL_LIMIT | bits.mjDSBL_CONSTRAINT,
    }
    return [feature for feature, bit in flags.items() if compiled.model.opt.disableflags & int(bit)]


# --- actuators -----------------------------------------------------------------------------------------------------


class _Actuators:
    """Actuators of a compiled model.

    Attributes
    ----------
    joints : list of str
        Joints with a motor of their own.
    motors : list of MotorSpec
        One for each joint or fixed tendon; empty if all of them are direct drives without limits, which `actuated`
        expresses.
    forces : list of (ForceSpec, comment)
    guessed, left_out : list of str
    """

    def __init__(self, compiled: Compiled, tree: MjcfTree, tendons: Tendons) -> None:
        self.compiled, self.tree = compiled, tree
        self.joints: list[str] = []
        self.forces: list[tuple[ForceSpec, str]] = []
        self.guessed: list[str] = []
        self.left_out: list[str] = []
        self.motors: list[MotorSpec] = []
        with_gains: list[str] = []
        for k in range(compiled.model.nactuator):
            joints = _driven_joints(compiled, tendons, k)
            name = compiled.name("actuator", k)
            if not joints or not set(joints) <= set(tree.ref):
                target = (
                    "a joint of several freedoms"
                    if _joint_of(compiled, k) is not None
                    else _describe_target(compiled, k)
                )
                rotor = ", with its armature" if not joints and compiled.model.actuator_armature[k] else ""
                self.left_out.append(f"actuator {name} on {target}{rotor}".replace("  ", " "))
                continue
            names = [compiled.joints[joint] for joint in joints]
            if value := _constant_force(compiled, k):
                comment = f"actuator {name}, which has no control input".replace("  ", " ")
                for joint, x in joints.items():
                    self.forces.append(
                        (ForceSpec(joint=compiled.joints[joint], value=round_number(value * x)), comment)
                    )
                continue
            if len(names) > 1 or names[0] not in self.joints:
                self.joints += names if len(names) == 1 else []
                self._add_motor(k, joints)
            with_gains += [] if _is_direct_drive(compiled, k) else names
        if all(motor.joint is not None and motor.ratio == 1.0 and motor.torque_limit is None for motor in self.motors):
            self.motors = []
        if with_gains:
            listed = list_names(list(dict.fromkeys(with_gains)))
            self.left_out.append(f"gains and curves of actuators, whose joints have motors instead: {listed}")

    def _add_motor(self, k: int, joints: dict[int, float]) -> None:
        """Add an actuator as a motor. The armature of a joint includes that of the joint's actuator already."""
        model, names = self.compiled.model, self.compiled.joints
        first = names[next(iter(joints))]
        name = make_unique(self.compiled.name("actuator", k) or first, [str(motor.name) for motor in self.motors])
        ratio = round_number(float(model.actuator_gear[k, 0])) or 1.0
        limits = _torque_limits(self.compiled, k, joints)
        if limits[0] > 0 or limits[1] < 0 or limits[0] == limits[1]:
            self.left_out.append(f"torque limits {limits[0]:g} to {limits[1]:g} of actuator {name}, which exclude 0")
            limits = -math.inf, math.inf
        if _joint_of(self.compiled, k) is not None:
            spec = MotorSpec(name=name, joint=first, ratio=ratio, torque_limit=_limit_of(limits))
        else:
            spec = MotorSpec(
                name=name,
                joints={names[joint]: round_number(x) for joint, x in joints.items()},
                ratio=ratio,
                rotor_inertia=round_number(float(model.actuator_armature[k])),
                torque_limit=_limit_of(limits),
            )
            if spec.rotor_inertia and len(joints) > 1:
                self.guessed.append(
                    f"the rotor of motor {name} couples the inertias of all its joints; MuJoCo neglects that between "
                    "joints of different branches"
                )
        self.motors.append(spec)


def _driven_joints(compiled: Compiled, tendons: Tendons, k: int) -> dict[int, float]:
    """Return the joints that an actuator drives, with their coefficients; empty for other targets."""
    joint = _joint_of(compiled, k)
    if joint is not None:
        return {joint: 1.0}
    if int(compiled.model.actuator_trntype[k]) != compiled.mujoco.mjtTrn.mjTRN_TENDON:
        return {}
    return {j: x for j, x in tendons.tendons[int(compiled.model.actuator_trnid[k, 0])].joints if x}


def _torque_limits(compiled: Compiled, k: int, joints: dict[int, float]) -> tuple[float, float]:
    """Return the limits of an actuator's torque before its gear: its own, and those of the joint or tendon."""
    model = compiled.model
    gear = float(model.actuator_gear[k, 0]) or 1.0
    ranges = []
    if model.actuator_forcelimited[k]:
        ranges.append(model.actuator_forcerange[k])
    if model.actuator_ctrllimited[k] and _is_direct_drive(compiled, k):
        ranges.append(float(model.actuator_gainprm[k, 0]) * model.actuator_ctrlrange[k])
    target = int(model.actuator_trnid[k, 0])
    on = "jnt" if _joint_of(compiled, k) is not None else "tendon"
    if getattr(model, f"{on}_actfrclimited")[target]:
        ranges.append(getattr(model, f"{on}_actfrcrange")[target] / gear)
    if on == "tendon":
        ranges += [model.jnt_actfrcrange[j] / (gear * x) for j, x in joints.items() if model.jnt_actfrclimited[j]]
    lower = max((float(min(limits)) for limits in ranges), default=-math.inf)
    return lower, min((float(max(limits)) for limits in ranges), default=math.inf)


def _limit_of(limits: tuple[float, float]) -> float | list[float] | None:
    """Return lower and upper limits as the torque_limit of a motor."""
    lower, upper = (round_number(x) if math.isfinite(x) else x for x in limits)
    return None if math.isinf(upper) else upper if lower == -upper else [lower, upper]


def _actuated_joints(compiled: Compiled) -> set[int]:
    """Return the joints on which an actuator acts."""
    joints = (_joint_of(compiled, k) for k in range(compiled.model.nactuator))
    return {joint for joint in joints if joint is not None}


def _joint_of(compiled: Compiled, k: int) -> int | None:
    model, kinds = compiled.model, compiled.mujoco.mjtTrn
    on_joint = int(model.actuator_trntype[k]) in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT)
    return int(model.actuator_trnid[k, 0]) if on_joint else None


def _describe_target(compiled: Compiled, k: int) -> str:
    """Return type and name of the target of an actuator that does not act on a joint."""
    model, kinds = compiled.model, compiled.mujoco.mjtTrn
    targets = {
        int(kinds.mjTRN_TENDON): "tendon",
        int(kinds.mjTRN_SITE): "site",
        int(kinds.mjTRN_SLIDERCRANK): "site",
        int(kinds.mjTRN_BODY): "body",
    }
    kind = targets.get(int(model.actuator_trntype[k]), "")
    return f"{kind} {compiled.name(kind, model.actuator_trnid[k, 0])}" if kind else "no joint"


def _constant_force(compiled: Compiled, k: int) -> float:
    """Return the force of an actuator without control input, as `ckc export` writes one; 0 for any other actuator."""
    model, mujoco = compiled.model, compiled.mujoco
    has_input = int(model.actuator_gaintype[k]) != mujoco.mjtGain.mjGAIN_FIXED or model.actuator_gainprm[k].any()
    bias = model.actuator_biasprm[k]
    if has_input or int(model.actuator_biastype[k]) != mujoco.mjtBias.mjBIAS_AFFINE or bias[1:].any():
        return 0.0
    return float(model.actuator_gear[k, 0] * bias[0])


def _is_direct_drive(compiled: Compiled, k: int) -> bool:
    """Whether an actuator's force is proportional to its control."""
    model, mujoco = compiled.model, compiled.mujoco
    kinds = [int(kind[k]) for kind in (model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)]
    direct = [mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE]
    return kinds == [int(kind) for kind in direct] and bool(model.actuator_gear[k, 0])


# --- points --------------------------------------------------------------------------------------------------------


def _free_sites(compiled: Compiled, tree: MjcfTree) -> list[tuple[PointSpec, str]]:
    """Return a point for each named site that no equality, tendon or actuator uses."""
    used, points = set(_used_sites(compiled)), []
    for site in range(compiled.model.nsite):
        name = compiled.name("site", site)
        if name and site not in used:
            placed = tree.site(site)
            frame = make_frame(placed.link, pin.SE3(np.eye(3), placed.pose.translation))
            points.append((PointSpec(name=name, frame=frame), ""))
    return points


def _used_sites(compiled: Compiled) -> Iterator[int]:
    model, mujoco = compiled.model, compiled.mujoco
    for k in range(model.neq):
        if int(model.eq_objtype[k]) == mujoco.mjtObj.mjOBJ_SITE:
            yield from (int(model.eq_obj1id[k]), int(model.eq_obj2id[k]))
    for k in range(model.nwrap):
        if int(model.wrap_type[k]) == mujoco.mjtWrap.mjWRAP_SITE:
            yield int(model.wrap_objid[k])
        elif int(model.wrap_type[k]) in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER):
            yield int(model.wrap_prm[k])  # the side site, which selects the side on which a tendon wraps
    for k in range(model.nactuator):
        if int(model.actuator_trntype[k]) in (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK):
            yield from (int(site) for site in model.actuator_trnid[k])
