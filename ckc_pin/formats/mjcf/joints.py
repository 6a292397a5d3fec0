"""A joint as MuJoCo compiled it: its place, axis, value in the reference pose, range, and what acts on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.formats.draft import number
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.orientation import from_axis_angle
from ckc_pin.formats.urdf.elements import UNLIMITED, JointLimits

__all__ = ["Joint", "is_free_root"]

KINDS = ("free", "ball", "slide", "hinge")


@dataclass(frozen=True)
class Joint:
    """A joint of a body, in the body's frame.

    Attributes
    ----------
    number : int
        MuJoCo's.
    name : str
    kind : str
        hinge, slide, ball or free.
    at_qpos : int
        Where its values begin in qpos.
    at, axis : (3,) arrays
        The point that it turns about; its direction, of length 1.
    ref : float
        Its value in the reference pose, rad or m.
    limits : JointLimits
    stops : bool
        Whether they act.
    stiffness, rest, damping, friction, armature : float
        Damping and armature with those of the actuators on it.
    is_nonlinear : bool
        Whether stiffness or damping have terms of higher order.
    """

    number: int
    name: str
    kind: str
    at_qpos: int
    at: Array
    axis: Array
    ref: float
    limits: JointLimits
    stops: bool
    stiffness: float
    rest: float
    damping: float
    friction: float
    armature: float
    is_nonlinear: bool

    @classmethod
    def read(cls, compiled: Compiled, at: int) -> Joint:
        """Read a joint by its number."""
        model, kind = compiled.model, KINDS[compiled.model.jnt_type[at]]
        dof, qpos = int(model.jnt_dofadr[at]), int(model.jnt_qposadr[at])
        damping, armature = float(model.dof_damping[dof]), float(model.dof_armature[dof])
        through = (compiled.mujoco.mjtTrn.mjTRN_JOINT, compiled.mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        for k in range(model.nactuator):
            if int(model.actuator_trntype[k]) in through and model.actuator_trnid[k, 0] == at:
                gear = float(model.actuator_gear[k, 0])
                damping += gear**2 * float(model.actuator_damping[k])
                armature += gear**2 * float(model.actuator_armature[k])
        return cls(
            number=at,
            name=compiled.joints[at],
            kind=kind,
            at_qpos=qpos,
            at=np.zeros(3) if kind == "free" else model.jnt_pos[at].copy(),
            axis=model.jnt_axis[at].copy(),
            ref=float(model.qpos0[qpos]) if kind in ("hinge", "slide") else 0.0,
            limits=_limits(compiled, at),
            stops=bool(model.jnt_limited[at]),
            stiffness=float(model.jnt_stiffness[at]),
            rest=float(model.qpos_spring[qpos]),
            damping=damping,
            friction=float(model.dof_frictionloss[dof]),
            armature=armature,
            is_nonlinear=bool(model.jnt_stiffnesspoly[at].any() or model.dof_dampingpoly[dof].any()),
        )

    @property
    def acting(self) -> list[str]:
        """What acts on the joint, by MuJoCo's words."""
        acting = {
            "damping": self.damping,
            "stiffness": self.stiffness,
            "frictionloss": self.friction,
            "armature": self.armature,
            "range": self.stops,
        }
        return [key for key, value in acting.items() if value]

    def turned(self, value: float) -> pin.SE3:
        """Displacement that a value of the joint stands for."""
        if self.kind == "slide":
            return pin.SE3(np.eye(3), value * self.axis)
        return pin.SE3(from_axis_angle(self.axis, value) if value else np.eye(3), np.zeros(3))


def is_free_root(joints: Sequence[Joint]) -> bool:
    """Whether three slides and a ball are a free joint: across each other, about the body's origin, nothing acting."""
    if [joint.kind for joint in joints] != ["slide", "slide", "slide", "ball"] or joints[3].at.any():
        return False
    if any(set(joint.acting) - {"range"} for joint in joints):
        return False
    axes = np.array([joint.axis for joint in joints[:3]])
    return bool(np.abs(axes @ axes.T - np.eye(3)).max() < 1e-12)


def _limits(compiled: Compiled, at: int) -> JointLimits:
    model = compiled.model
    lower, upper = (number(float(x)) for x in model.jnt_range[at])
    if not model.jnt_limited[at] and not lower < upper:
        return UNLIMITED
    effort = float(np.abs(model.jnt_actfrcrange[at]).max()) if model.jnt_actfrclimited[at] else 0.0
    return JointLimits(lower, upper, effort)
