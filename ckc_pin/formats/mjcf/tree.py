"""Convert MuJoCo's bodies and joints to a URDF's links and joints, with the same coordinates.

A URDF joint places the frame of its child link. A MuJoCo joint turns a body about a point of that body. The frame of a
link is therefore the body's frame shifted to the body's last joint, and the tree stores the pose of every body in its
link. A joint's `ref`, its value in MuJoCo's reference pose, becomes part of the joint's origin, so coordinates keep
MuJoCo's values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.formats.conversion import (
    from_axis_angle,
    from_quaternion,
    list_names,
    make_unique,
    round_number,
    round_vector,
    to_rpy,
)
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.robot import UNLIMITED, Body, Joint, JointAxis, JointKind, JointLimits, Link, ball_axes
from ckc_pin.formats.urdf.elements import make_visuals

__all__ = ["MjcfTree", "Placed"]

ASSEMBLED_KEY = "assembled"  # name of the key frame that `ckc export` writes
JOINT_KINDS = ("free", "ball", "slide", "hinge")  # by mjtJoint
SHAPES = {2: "sphere", 3: "capsule", 5: "cylinder", 6: "box"}  # by mjtGeom
ORTHOGONAL_TOLERANCE = 1e-12  # between the axes of three slides
FREE_LABELS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Placed:
    """A frame by its pose in a link."""

    link: str
    pose: pin.SE3

    def at(self, pose: pin.SE3) -> Placed:
        """Return the frame at a pose in this frame."""
        return Placed(self.link, self.pose * pose)


# --- joints --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Joint:
    """A compiled joint, in the frame of its body."""

    number: int
    name: str
    kind: str  # hinge, slide, ball or free
    qpos_index: int  # where its values begin in qpos
    position: Array  # a point of the axis, m
    ref: float  # value in the reference pose, rad or m
    axis: JointAxis  # damping and armature include those of the actuators on the joint
    is_nonlinear: bool  # whether stiffness or damping have terms of higher order

    @classmethod
    def read(cls, compiled: Compiled, number: int) -> _Joint:
        """Read a joint of the compiled model."""
        model, kind = compiled.model, JOINT_KINDS[compiled.model.jnt_type[number]]
        dof, qpos = int(model.jnt_dofadr[number]), int(model.jnt_qposadr[number])
        axis = JointAxis(
            model.jnt_axis[number].copy(),
            slides=kind == "slide",
            limits=_read_limits(compiled, number),
            damping=float(model.dof_damping[dof]),
            friction=float(model.dof_frictionloss[dof]),
            armature=float(model.dof_armature[dof]),
            stiffness=float(model.jnt_stiffness[number]),
            rest=float(model.qpos_spring[qpos]),
            stops=bool(model.jnt_limited[number]),
        )
        on_joint = (compiled.mujoco.mjtTrn.mjTRN_JOINT, compiled.mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        for k in range(model.nactuator):
            if int(model.actuator_trntype[k]) in on_joint and model.actuator_trnid[k, 0] == number:
                gear = float(model.actuator_gear[k, 0])
                axis.damping += gear**2 * float(model.actuator_damping[k])
                axis.armature += gear**2 * float(model.actuator_armature[k])
        return cls(
            number=number,
            name=compiled.joints[number],
            kind=kind,
            qpos_index=qpos,
            position=np.zeros(3) if kind == "free" else model.jnt_pos[number].copy(),
            ref=float(model.qpos0[qpos]) if kind in ("hinge", "slide") else 0.0,
            axis=axis,
            is_nonlinear=bool(model.jnt_stiffnesspoly[number].any() or model.dof_dampingpoly[dof].any()),
        )

    @property
    def nonzero_properties(self) -> list[str]:
        """MuJoCo's names of the properties that produce forces or inertia at the joint."""
        axis = self.axis
        values = {"damping": axis.damping, "stiffness": axis.stiffness, "frictionloss": axis.friction}
        values |= {"armature": axis.armature, "range": axis.stops}
        return [key for key, value in values.items() if value]

    def displacement(self, value: float) -> pin.SE3:
        """Return the displacement by a value of the joint (rad or m), relative to zero."""
        if self.kind == "slide":
            return pin.SE3(np.eye(3), value * self.axis.direction)
        return pin.SE3(from_axis_angle(self.axis.direction, value) if value else np.eye(3), np.zeros(3))


def _is_free_root(joints: Sequence[_Joint]) -> bool:
    """Whether three slides and a ball are equivalent to a free joint.

    The slides must be orthogonal, the ball at the body's origin, and no joint may have damping, stiffness, friction or
    armature.
    """
    if [joint.kind for joint in joints] != ["slide", "slide", "slide", "ball"] or joints[3].position.any():
        return False
    if any(set(joint.nonzero_properties) - {"range"} for joint in joints):
        return False
    axes = np.array([joint.axis.direction for joint in joints[:3]])
    return bool(np.abs(axes @ axes.T - np.eye(3)).max() < ORTHOGONAL_TOLERANCE)


def _read_limits(compiled: Compiled, number: int) -> JointLimits:
    model = compiled.model
    lower, upper = (round_number(float(x)) for x in model.jnt_range[number])
    if not model.jnt_limited[number] and not lower < upper:
        return UNLIMITED
    effort = float(np.abs(model.jnt_actfrcrange[number]).max()) if model.jnt_actfrclimited[number] else 0.0
    return JointLimits(lower, upper, effort)


# --- tree ----------------------------------------------------------------------------------------------------------


@dataclass
class MjcfTree:
    """The bodies and joints of a compiled model."""

    compiled: Compiled
    used_joints: set[int]  # to which an actuator, a tendon or an equality constraint refers
    links: dict[str, Link] = field(default_factory=dict)
    joints: dict[str, Joint] = field(default_factory=dict)
    bodies: list[Placed] = field(default_factory=list)  # by MuJoCo's number
    ref: dict[int, float] = field(default_factory=dict)  # joints of one freedom with their values in the reference pose
    # The key frame "assembled" that `ckc export` writes, the first one, or the reference pose. Zeros are left out.
    q_guess: dict[str, float] = field(default_factory=dict)
    key_frames: dict[str, dict[str, float]] = field(default_factory=dict)
    guessed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        model = self.model = self.compiled.model
        self._link_names, self._joint_names = {"world", *self.compiled.bodies}, set(self.compiled.joints)
        names = [self.compiled.name("key", k) or f"key_{k}" for k in range(model.nkey)]
        order = sorted(range(model.nkey), key=lambda k: names[k] != ASSEMBLED_KEY)
        self._starts = [model.key_qpos[k] for k in order] or [model.qpos0]
        self._configs: list[dict[str, float]] = [self.q_guess, *({} for _ in order[1:])]
        self.key_frames = {names[k]: config for k, config in zip(order[1:], self._configs[1:], strict=True)}
        self.links["world"] = Link()
        self.bodies.append(Placed("world", pin.SE3.Identity()))
        for body in range(1, model.nbody):
            self._add_body(body)
        drawn = sum(_draw_shape(model, geom, *self._link_of(geom)) for geom in range(model.ngeom))
        self._add_notes(self.compiled.undrawn + model.ngeom - drawn)

    def site(self, number: int) -> Placed:
        """Return the frame of a site."""
        model = self.model
        return self.bodies[model.site_bodyid[number]].at(_pose(model.site_quat, model.site_pos, number))

    def _link_of(self, geom: int) -> tuple[Link, pin.SE3]:
        body = self.bodies[self.model.geom_bodyid[geom]]
        return self.links[body.link], body.pose * _pose(self.model.geom_quat, self.model.geom_pos, geom)

    def _add_notes(self, undrawn: int) -> None:
        model, names = self.model, self.compiled.bodies
        notes = {
            "masses of shapes whose mesh is missing; give the link an <inertial>": self.compiled.unweighed,
            "gravity compensation of bodies": [names[k] for k in np.flatnonzero(model.body_gravcomp)],
        }
        self.left_out += [f"{note}: {list_names(affected)}" for note, affected in notes.items() if affected]
        with_stops = [joint.name for joint in self.joints.values() if any(axis.stops for axis in joint.axes)]
        if with_stops:
            self.guessed.append(
                f"ranges are hard stops without rebound; in MuJoCo they are soft: {list_names(with_stops)}"
            )
        for k in np.flatnonzero(model.body_mocapid >= 0):
            self.left_out.append(f"external motion (mocap) of body {names[k]}: the body is fixed")
        if undrawn:
            self.left_out.append(f"{undrawn} shapes that are not boxes, cylinders, capsules or spheres: not drawn")

    # --- bodies ------------------------------------------------------------------------------------

    def _add_body(self, number: int) -> None:
        model, name = self.model, self.compiled.bodies[number]
        start = self.bodies[model.body_parentid[number]].at(_pose(model.body_quat, model.body_pos, number))
        first = model.body_jntadr[number]
        joints = [_Joint.read(self.compiled, first + k) for k in range(model.body_jntnum[number])]
        on_world = model.body_parentid[number] == 0
        if [joint.kind for joint in joints] == ["free"]:
            if joints[0].nonzero_properties:
                self.left_out.append(f"{', '.join(joints[0].nonzero_properties)} of free joint {joints[0].name}")
            first = joints[0].qpos_index

            def read_pose(qpos: Array) -> pin.SE3:
                return pin.SE3(from_quaternion(qpos[first + 3 : first + 7]), qpos[first : first + 3].copy())

            pose = self._add_free(joints[0].name, name, read_pose)
        elif on_world and _is_free_root(joints) and not self.used_joints & {joint.number for joint in joints}:
            self.guessed.append(f"the three slides and the ball of body {name} are one free joint, 'root'")
            self.left_out += [f"range of joint {joint.name}, part of 'root'" for joint in joints if joint.axis.stops]
            first = joints[0].qpos_index

            def compose_pose(qpos: Array) -> pin.SE3:
                shift = sum(
                    ((x - j.ref) * j.axis.direction for x, j in zip(qpos[first:], joints[:3], strict=False)),
                    np.zeros(3),
                )
                return start.pose * pin.SE3(from_quaternion(qpos[first + 3 : first + 7]), shift)

            pose = self._add_free(make_unique("root", self._joint_names), name, compose_pose)
        else:
            pose = self._add_chain(joints, name, start)
        self.bodies.append(Placed(name, pose))
        self.links[name].body = self._inertia(number).transformed(pose)

    def _inertia(self, number: int) -> Body:
        """Return mass and inertia of a body in the body's frame."""
        if number in self.compiled.weightless:
            return Body(0.0, np.zeros(3), np.zeros((3, 3)))
        model = self.model
        principal = Body(float(model.body_mass[number]), np.zeros(3), np.diag(model.body_inertia[number]))
        return principal.transformed(_pose(model.body_iquat, model.body_ipos, number))

    # --- joints ------------------------------------------------------------------------------------

    def _add_free(self, name: str, body: str, read_pose: Callable[[Array], pin.SE3]) -> pin.SE3:
        """Add a floating joint, whose coordinates are the body's world pose; return the body's pose in its link."""
        self._joint_names.add(name)
        self._add_joint(name, "floating", "world", body, pin.SE3.Identity())

        def read(qpos: Array) -> Iterable[Any]:
            pose = read_pose(qpos)
            return (*pose.translation, *pin.log3(pose.rotation))

        self._set_guess([f"{name}.{label}" for label in FREE_LABELS], read)
        return pin.SE3.Identity()

    def _add_chain(self, joints: Sequence[_Joint], body: str, start: Placed) -> pin.SE3:
        """Add a body's joints in series, connected by links without mass; return the body's pose in its link."""
        link, pose = start.link, start.pose
        if not joints:
            self._add_joint(make_unique(f"{body}_fixed", self._joint_names), "fixed", link, body, pose)
            return pin.SE3.Identity()
        for joint in joints:
            is_last = joint is joints[-1]
            child = body if is_last else make_unique(f"{body}_{joint.name}_link", self._link_names)
            origin = pose * pin.SE3(np.eye(3), joint.position)
            if joint.kind == "ball":
                self._add_ball(joint, link, child, origin)
            else:
                self._add_hinge_or_slide(joint, link, child, origin * joint.displacement(-joint.ref))
            link, pose = child, pin.SE3(np.eye(3), -joint.position)
        return pose

    def _add_hinge_or_slide(self, joint: _Joint, link: str, child: str, origin: pin.SE3) -> None:
        """Add a joint of one freedom with its range, damping, friction and spring."""
        axis = replace(joint.axis, direction=np.array(round_vector(joint.axis.direction)))
        self._add_joint(joint.name, "prismatic" if axis.slides else "revolute", link, child, origin, [axis])
        if joint.is_nonlinear:
            self.left_out.append(f"quadratic and cubic parts of stiffness or damping of joint {joint.name}")
        self.ref[joint.number] = round_number(joint.ref)
        self._set_guess([joint.name], lambda qpos: [qpos[joint.qpos_index]])

    def _add_ball(self, joint: _Joint, link: str, child: str, origin: pin.SE3) -> None:
        """Add three hinges in series for a ball joint."""
        names = [make_unique(f"{joint.name}_{axis}", self._joint_names) for axis in "xyz"]
        self._joint_names.update(names)
        suffixes = [name.removeprefix(joint.name) for name in names]
        self._add_joint(joint.name, "ball", link, child, origin, ball_axes(suffixes))

        def read(qpos: Array) -> Iterable[Any]:
            # The hinges turn about x, y and z in this order: their angles are the inverse's with opposite sign.
            rotation = from_quaternion(qpos[joint.qpos_index : joint.qpos_index + 4])
            return [-angle for angle in to_rpy(rotation.T)]

        self._set_guess(names, read)
        if joint.nonzero_properties:
            self.left_out.append(f"{', '.join(joint.nonzero_properties)} of ball joint {joint.name}")

    def _set_guess(self, labels: Sequence[str], read: Callable[[Array], Iterable[Any]]) -> None:
        """Read coordinates from the values of qpos of each start."""
        for config, qpos in zip(self._configs, self._starts, strict=True):
            rounded = {label: round_number(float(x)) for label, x in zip(labels, read(qpos), strict=True)}
            config |= {label: x for label, x in rounded.items() if x != 0 or config is not self.q_guess}

    def _add_joint(
        self, name: str, kind: JointKind, parent: str, child: str, origin: pin.SE3, axes: Sequence[JointAxis] = ()
    ) -> None:
        self._link_names.add(child)
        self.links[child] = Link()
        self.joints[name] = Joint(name, kind, parent, child, origin, axes=list(axes))


def _pose(quaternions: Array, positions: Array, number: int) -> pin.SE3:
    return pin.SE3(from_quaternion(quaternions[number]), positions[number].copy())


def _draw_shape(model: Any, geom: int, link: Link, pose: pin.SE3) -> bool:
    """Add a shape to a link; return False if URDF has no such shape."""
    shape = SHAPES.get(int(model.geom_type[geom]))
    if shape:
        size = 2 * model.geom_size[geom]
        link.visuals += make_visuals(pose, shape, size, float(size[0]) / 2, float(size[1]))
    return shape is not None
