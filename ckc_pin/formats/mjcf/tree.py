"""MuJoCo's bodies and joints to a URDF's links and joints, without a change of what the coordinates mean.

A URDF joint moves its child's frame, a MuJoCo joint turns a body about a point of that body. So the frame of
a link is that of the body shifted to its last joint, and every body is remembered with its pose in its link.
A joint's `ref`, its value in the reference pose, goes into the joint's origin: the numbers stay MuJoCo's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.formats.draft import number, some, unique, vector
from ckc_pin.formats.mjcf.compiled import Compiled
from ckc_pin.formats.mjcf.joints import Joint, is_free_root
from ckc_pin.formats.mjcf.shapes import draw
from ckc_pin.formats.orientation import from_quaternion, to_rpy
from ckc_pin.formats.urdf.elements import UNLIMITED, Body, JointLimits, add_inertial, add_joint, add_link
from ckc_pin.mechanism.spec import JointSpec, SpringSpec

__all__ = ["MjcfTree", "Placed"]


@dataclass(frozen=True)
class Placed:
    """Where something stands: its pose in a link."""

    link: str
    pose: pin.SE3

    def at(self, pose: pin.SE3) -> Placed:
        """Return what stands at a pose in this."""
        return Placed(self.link, self.pose * pose)


@dataclass
class MjcfTree:
    """The tree of a model.

    Parameters
    ----------
    compiled : Compiled
    used : set of int
        Joints that an actuator, a tendon or an equality names.

    Attributes
    ----------
    robot : Element
        The URDF.
    bodies : list of Placed
        By MuJoCo's number.
    ref : dict of int to float
        Joints of one freedom and their values in the reference pose.
    q_guess : dict of str to float
        The reference pose, or the key frame that `ckc export` writes, by coordinate, where it is not zero.
    springs : list of (SpringSpec, comment)
    joints : list of (JointSpec, comment)
        Armature, and the ranges that act, which a URDF has no words for.
    guessed, left_out : list of str
    """

    compiled: Compiled
    used: set[int]
    robot: Element = field(default_factory=lambda: Element("robot"))
    bodies: list[Placed] = field(default_factory=list)
    ref: dict[int, float] = field(default_factory=dict)
    q_guess: dict[str, float] = field(default_factory=dict)
    springs: list[tuple[SpringSpec, str]] = field(default_factory=list)
    joints: list[tuple[JointSpec, str]] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        model = self.model = self.compiled.model
        self._links, self._joints = {"world", *self.compiled.bodies}, set(self.compiled.joints)
        self._start = model.key_qpos[0] if model.nkey else model.qpos0
        self._elements = {"world": add_link(self.robot, "world")}
        self.bodies.append(Placed("world", pin.SE3.Identity()))
        for number_ in range(1, model.nbody):
            self._body(number_)
        undrawn = self.compiled.undrawn + sum(not draw(model, k, *self._link_of(k)) for k in range(model.ngeom))
        self._notes(undrawn)

    def site(self, number_: int) -> Placed:
        """Return where a site is."""
        model = self.model
        return self.bodies[model.site_bodyid[number_]].at(_pose(model.site_quat, model.site_pos, number_))

    def _link_of(self, geom: int) -> tuple[Element, pin.SE3]:
        placed = self.bodies[self.model.geom_bodyid[geom]]
        return self._elements[placed.link], placed.pose * _pose(self.model.geom_quat, self.model.geom_pos, geom)

    def _notes(self, undrawn: int) -> None:
        model, names = self.model, self.compiled.bodies
        notes = {
            "masses of shapes unknown here; give the link an <inertial>": self.compiled.unweighed,
            "gravity compensation of bodies": [names[k] for k in np.flatnonzero(model.body_gravcomp)],
        }
        self.left_out += [f"{what}: {some(which)}" for what, which in notes.items() if which]
        stopped = [spec.name for spec, _ in self.joints if spec.stops]
        if stopped:
            self.guessed.append(f"ranges are hard stops without rebound here, MuJoCo's give way: {some(stopped)}")
        for k in np.flatnonzero(model.body_mocapid >= 0):
            self.left_out.append(f"body {names[k]} is moved from outside (mocap): it stands still here")
        if undrawn:
            self.left_out.append(f"{undrawn} shapes that are no box, cylinder or sphere: not drawn")

    # --- bodies ----------------------------------------------------------------------------------

    def _body(self, at: int) -> None:
        model, name = self.model, self.compiled.bodies[at]
        start = self.bodies[model.body_parentid[at]].at(_pose(model.body_quat, model.body_pos, at))
        first = model.body_jntadr[at]
        joints = [Joint.read(self.compiled, first + k) for k in range(model.body_jntnum[at])]
        on_world = model.body_parentid[at] == 0
        if [joint.kind for joint in joints] == ["free"]:
            if joints[0].acting:
                self.left_out.append(f"{', '.join(joints[0].acting)} of free joint {joints[0].name}")
            qpos = self._start[joints[0].at_qpos :]
            pose = self._free(joints[0].name, name, pin.SE3(from_quaternion(qpos[3:7]), qpos[:3].copy()))
        elif on_world and is_free_root(joints) and not self.used & {joint.number for joint in joints}:
            self.guessed.append(f"the three slides and the ball of body {name} are one free joint, 'root'")
            self.left_out += [f"range of joint {joint.name}, part of 'root'" for joint in joints if joint.stops]
            values = self._start[joints[0].at_qpos :]
            moved = sum(((x - j.ref) * j.axis for x, j in zip(values[:3], joints, strict=False)), np.zeros(3))
            pose = self._free(
                unique("root", self._joints), name, start.pose * pin.SE3(from_quaternion(values[3:7]), moved)
            )
        else:
            pose = self._chain(joints, name, start)
        self.bodies.append(Placed(name, pose))
        add_inertial(self._elements[name], self._inertia(at).moved(pose))

    def _inertia(self, at: int) -> Body:
        """Mass and inertia in the body's frame."""
        if at in self.compiled.weightless:
            return Body(0.0, np.zeros(3), np.zeros((3, 3)))
        model = self.model
        principal = Body(float(model.body_mass[at]), np.zeros(3), np.diag(model.body_inertia[at]))
        return principal.moved(_pose(model.body_iquat, model.body_ipos, at))

    # --- joints ----------------------------------------------------------------------------------

    def _free(self, name: str, body: str, start: pin.SE3) -> pin.SE3:
        """Add a floating joint; its coordinates are the body's pose in the world."""
        self._joints.add(name)
        self._join(name, "floating", "world", body, pin.SE3.Identity())
        values = (*start.translation, *pin.log3(start.rotation))
        self._guess((f"{name}.{label}" for label in ("x", "y", "z", "rx", "ry", "rz")), values)
        return pin.SE3.Identity()

    def _chain(self, joints: Sequence[Joint], body: str, start: Placed) -> pin.SE3:
        """Add a body's joints one after another, massless links between them; return its pose in its link."""
        link, pose = start.link, start.pose
        if not joints:
            self._join(unique(f"{body}_fixed", self._joints), "fixed", link, body, pose)
            return pin.SE3.Identity()
        for position, joint in enumerate(joints):
            last = position == len(joints) - 1
            child = body if last else unique(f"{body}_{joint.name}_link", self._links)
            origin = pose * pin.SE3(np.eye(3), joint.at)
            if joint.kind == "ball":
                self._ball(joint, link, child, origin)
            else:
                self._scalar(joint, link, child, origin * joint.turned(-joint.ref))
            link, pose = child, pin.SE3(np.eye(3), -joint.at)
        return pose

    def _scalar(self, joint: Joint, link: str, child: str, origin: pin.SE3) -> None:
        """Add a hinge or a slide, with its range, damping, friction and spring."""
        kind = "prismatic" if joint.kind == "slide" else ("continuous" if joint.limits.lower is None else "revolute")
        self._join(
            joint.name, kind, link, child, origin, joint.axis, joint.limits, joint.damping, joint.friction
        )  # fmt: skip
        if joint.stiffness:
            spec = SpringSpec(joint=joint.name, stiffness=joint.stiffness, rest=number(joint.rest))
            self.springs.append((spec, "the joint's stiffness"))
        if joint.is_nonlinear:
            self.left_out.append(f"quadratic and cubic parts of stiffness or damping of joint {joint.name}")
        if joint.armature or joint.stops:
            self.joints.append((JointSpec(name=joint.name, armature=joint.armature or None, stops=joint.stops), ""))
        self.ref[joint.number] = number(joint.ref)
        self._guess([joint.name], [self._start[joint.at_qpos]])

    def _ball(self, joint: Joint, link: str, child: str, origin: pin.SE3) -> None:
        """Add three hinges through massless links for a ball joint."""
        names = [unique(f"{joint.name}_{axis}", self._joints) for axis in "xyz"]
        for position, (name, axis) in enumerate(zip(names, np.eye(3), strict=True)):
            below = child if position == 2 else unique(f"{child}_{'xy'[position]}", self._links)
            self._joints.add(name)
            self._join(name, "continuous", link, below, origin, axis)
            link, origin = below, pin.SE3.Identity()
        turned = from_quaternion(self._start[joint.at_qpos : joint.at_qpos + 4])
        self._guess(names, [-angle for angle in to_rpy(turned.T)])  # turns about x, y, z, one after another
        self.guessed.append(
            f"ball joint {joint.name} is three hinges, {', '.join(names)}: singular where {names[1]} is +-90 degrees"
        )
        if joint.acting:
            self.left_out.append(f"{', '.join(joint.acting)} of ball joint {joint.name}")

    def _guess(self, labels: Iterable[str], values: Iterable[Any]) -> None:
        self.q_guess |= {
            label: number(float(x)) for label, x in zip(labels, values, strict=True) if abs(number(float(x))) > 0
        }

    def _join(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        origin: pin.SE3,
        axis: Sequence[float] | Array = (),
        limits: JointLimits = UNLIMITED,
        damping: float = 0.0,
        friction: float = 0.0,
    ) -> None:
        self._links.add(child)
        self._elements[child] = add_link(self.robot, child)
        direction = vector(axis) if len(axis) else ()
        add_joint(self.robot, name, kind, parent, child, origin, direction, limits, damping, friction)


def _pose(quaternions: Array, positions: Array, at: int) -> pin.SE3:
    return pin.SE3(from_quaternion(quaternions[at]), positions[at].copy())
