"""Loops as joints between two frames, for formats whose joints close loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["LoopJoint", "loop_joint", "place_in_plane"]

PLANE_TOLERANCE = 1e-9  # of the mechanism's size; how far a planar loop may leave its plane
PLANE_CONFIGURATIONS = 5  # random ones, at which this is checked
JOINT_KINDS = {
    "point": "ball", "hinge": "revolute", "point_2d": "revolute", "cylindrical": "cylindrical",
    "universal": "universal", "prismatic": "prismatic", "weld": "fixed",
}  # fmt: skip


@dataclass(frozen=True)
class LoopJoint:
    """A joint that closes a loop: its kind, its frame in both links, and its axis in both frames.

    The first axis of a universal joint is fixed in the first link, the second one in the second link.
    """

    name: str
    kind: str
    links: tuple[str, str]
    poses: tuple[pin.SE3, pin.SE3]
    axes: tuple[Array, Array]

    @property
    def aligned_poses(self) -> tuple[pin.SE3, pin.SE3]:
        """The frames rotated so that their axis is z; of a universal joint, so that its axes are x and y."""
        directions = np.eye(3)[:2] if self.kind == "universal" else np.eye(3)[[2, 2]]
        turns = [_turn(*pair) for pair in zip(directions, self.axes, strict=True)]
        if self.kind in ("prismatic", "fixed"):  # their frames coincide
            turns[1] = turns[0]
        one, two = (pose * pin.SE3(turn, np.zeros(3)) for pose, turn in zip(self.poses, turns, strict=True))
        return one, two


def loop_joint(mechanism: Mechanism, loop: LoopSpec, program: str) -> LoopJoint:
    """Return a loop as a joint. A `point_2d` that stays in its plane is a hinge.

    Raises
    ------
    InputError
        The program has no joint that allows the same motions.
    """
    if loop.type not in JOINT_KINDS:
        raise InputError(
            f"{mechanism.name}: loop {loop.name!r}: {program} has no joint for type {loop.type!r}; supported are "
            f"{', '.join(JOINT_KINDS)}"
        )
    a = mechanism.frames.find(loop.frame_a, f"loop {loop.name!r}, frame_a")
    b = mechanism.frames.find(loop.frame_b, f"loop {loop.name!r}, frame_b")
    axes = [np.array(axis) / np.linalg.norm(axis) for axis in (loop.axis_a, loop.axis_b)]
    if loop.type == "point_2d":
        b = place_in_plane(mechanism, loop, a, b, program)
        pose = Pose(mechanism.tree, mechanism.closure.anchors, mechanism.q_tree)
        rotations = [pose.rotation[frame.joint] @ frame.rotation for frame in (a, b)]
        normal = axes[0] if loop.rows_in == "world" else rotations[0] @ axes[0]
        axes = [rotation.T @ normal for rotation in rotations]
    one, two = (mechanism.frames.bodies[frame.joint] if frame.joint else "world" for frame in (a, b))
    poses = [pin.SE3(frame.rotation, frame.translation) for frame in (a, b)]
    return LoopJoint(loop.name, JOINT_KINDS[loop.type], (one, two), (poses[0], poses[1]), (axes[0], axes[1]))


def place_in_plane(mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame, program: str) -> Frame:
    """Return frame B of a `point_2d` shifted along the normal into frame A's plane.

    Raises
    ------
    InputError
        The loop leaves the plane, so the offset along the normal is not constant.
    """
    tree, random = mechanism.tree, np.random.default_rng(1)
    axis = np.array(loop.axis_a) / np.linalg.norm(loop.axis_a)
    joints, points = np.array([a.joint, b.joint], np.intp), np.array([a.translation, b.translation])
    anchors = Anchors(joints, points, np.zeros(0, np.intp), np.zeros((0, 3)))
    offsets, normals_in_b = [], []
    for step in [np.zeros(tree.n), *random.normal(size=(PLANE_CONFIGURATIONS, tree.n))]:
        pose = Pose(tree, anchors, tree.integrate(mechanism.q_tree, step))
        normal = axis if loop.rows_in == "world" else pose.rotation[a.joint] @ a.rotation @ axis
        offsets.append(normal @ pose.r[0])
        normals_in_b.append(pose.rotation[b.joint].T @ normal)
    if max(np.ptp(offsets), np.ptp(normals_in_b, axis=0).max()) > PLANE_TOLERANCE * mechanism.size:
        raise InputError(
            f"{mechanism.name}: loop {loop.name!r}: {program} cannot express a point_2d whose frames leave the plane"
        )
    return Frame(b.joint, b.rotation, b.translation + offsets[0] * normals_in_b[0])


def _turn(direction: Array, to: Array) -> Array:
    return np.array(pin.Quaternion.FromTwoVectors(direction, to).matrix())
