"""Loops and points of a mechanism as functions of its geometric parameters, with exact derivatives, for many poses.

Joints, frames of loops and named points are bodies here, each placed on a joint. A parameter moves bodies with a twist,
as a coordinate of the tree does. Derivatives with respect to parameters are therefore those of the same constraint
rows along other columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy

import numpy as np
import pinocchio as pin
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, IntArray, lazy
from ckc_pin.mechanism.batch import ManyPoses, evaluate_closure, evaluate_group
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap, list_loop_frames
from ckc_pin.mechanism.pose import Anchors
from ckc_pin.mechanism.rows import Affine, Distance, RelativeLog, Rows, skew

__all__ = ["Geometry"]

ROTATIONS, OFFSETS = ("rotation", "point_rotation", "no_rotation"), ("offset", "point", "reported")  # by kind of body


class Geometry:
    """The constraint function and the named points of a mechanism at any values of some parameters.

    Parameters
    ----------
    mechanism : Mechanism
    names : sequence of str
        Single geometric parameters.

    Attributes
    ----------
    values : (p,) array
        The values that `set_values` has set; at first those of the mechanism.
    tree, closure : Tree, Closure
        With these values.
    """

    def __init__(self, mechanism: Mechanism, names: Sequence[str]) -> None:
        self.names, self.tree, self._base = tuple(names), deepcopy(mechanism.tree), mechanism.closure
        self._map = ParameterMap(mechanism, mechanism.overrides)
        frames = list_loop_frames(mechanism.spec)
        self._frames = {tuple(name.removeprefix("loop.").rsplit(".", 1)): k for k, (name, _) in enumerate(frames)}
        points = [frame.joint for frame in mechanism.points.values()]
        placed = [*(mechanism.frames.find(frame, "parameters").joint for _, frame in frames), *points]
        self._carriers = np.array([*self.tree.model.parents, *placed], dtype=np.intp)  # joint by body
        self._axes = np.array([*range(self.tree.model.njoints), *placed], dtype=np.intp)  # joint that turns with a body
        self._point_bodies = np.arange(len(self._axes) - len(points), len(self._axes))
        no_rotation = np.tile(np.eye(3), (len(points), 1, 1))
        self._numbers: Mapping[str, Array] = {**self._map.all_numbers, "no_rotation": no_rotation}
        self.set_values(np.array([self._map.value_of(name) for name in names]))

    def set_values(self, values: Array) -> None:
        """Place joints, frames and points as other values of the parameters place them."""
        self.values = values
        changed, slopes = self._map.linearize(self.names, values) if self.names else ({}, {})
        numbers = {**self._numbers, **changed}
        zeros = {key: np.zeros((len(values), *numbers[key].shape)) for key in (*ROTATIONS, *OFFSETS)}
        rotation = np.concatenate([numbers[key] for key in ROTATIONS])
        spin = np.concatenate([slopes.get(key, zeros[key]) for key in ROTATIONS], axis=1) @ np.swapaxes(rotation, 1, 2)
        self._turn = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)  # in the carrier's axes
        self._slide = np.concatenate([slopes.get(key, zeros[key]) for key in OFFSETS], axis=1)
        self._offset = np.concatenate([numbers[key] for key in OFFSETS])
        self._slopes = slopes
        for k in range(1, self.tree.model.njoints):
            self.tree.model.jointPlacements[k] = pin.SE3(rotation[k], self._offset[k])
        self.closure = self._place_closure(numbers)

    def evaluate(self, q_tree: Array) -> tuple[Array, Array]:
        """Return phi (count, rows) and J (count, rows, n) at configurations (count, nq)."""
        return evaluate_closure(self.tree, self.closure, q_tree)

    def points(self, q_tree: Array) -> tuple[Array, Array]:
        """Return the positions (count, points, 3) of the named points in the world, and their Jacobians by q'."""
        poses = ManyPoses(self.tree, self._point_anchors(self._axes), q_tree)
        return poses.p, poses.p_jacobian

    def parameter_derivatives(self, q_tree: Array) -> tuple[Array, Array]:
        """Return the derivatives of phi (count, rows, p) and of the points (count, points, 3, p) at fixed q'."""
        count, p = len(q_tree), len(self.names)
        if not p:
            return np.zeros((count, self.closure.rows, 0)), np.zeros((count, len(self._point_bodies), 3, 0))
        closure, twist = self._closure_of_bodies, self._twists(self.tree.many_kinematics(q_tree)[0])
        poses = _ParameterPoses(self, closure.anchors, q_tree, twist)
        phi = np.zeros((count, self.closure.rows, p))
        for group in closure.groups:
            out = group.out
            if isinstance(group, Affine):
                zeros = np.zeros((p, self.closure.rows, self.tree.n))
                slope = self._slopes.get("affine", zeros)[:, out]
                phi[:, out] = np.einsum("prn,kn->krp", slope, q_tree[:, self.tree.q_index])
                phi[:, out] -= self._slopes.get("affine_offset", zeros[..., 0])[:, out].T
                continue
            residual, phi[:, out] = evaluate_group(group, closure, poses)
            if isinstance(group, Distance) and "length" in self._slopes:
                phi[:, out] -= (1 + residual / group.length)[..., None] * self._slopes["length"][:, out].T
        points = _ParameterPoses(self, self._point_anchors(np.arange(len(self._axes))), q_tree, twist)
        return phi, points.p_jacobian

    # --- placements ------------------------------------------------------------------------------

    def _place_closure(self, numbers: Mapping[str, Array]) -> Closure:
        """Return the closure with other numbers."""
        base, rotation = self._base, numbers["point_rotation"]
        turned = rotation @ np.swapaxes(self._numbers["point_rotation"], 1, 2)
        directions = np.array(base.anchors.direction_local)
        for k, frame in enumerate(base.direction_frames):
            if frame in self._frames:
                directions[k] = turned[self._frames[frame]] @ directions[k]

        def place(group: Rows) -> Rows:
            if isinstance(group, Distance):
                return replace(group, length=numbers["length"][group.out])
            if isinstance(group, Affine):
                matrix, offset = numbers["affine"][group.out], numbers["affine_offset"][group.out]
                return replace(group, matrix=matrix, offset=offset)
            if isinstance(group, RelativeLog):
                a, b = (rotation[self._frames_of(group, end)] for end in ("frame_a", "frame_b"))
                return replace(group, rotation_a=a, rotation_b=b)
            return group

        anchors = replace(base.anchors, point_local=numbers["point"], direction_local=directions)
        return replace(base, anchors=anchors, groups=tuple(map(place, base.groups)))

    @property
    def _closure_of_bodies(self) -> Closure:
        """The closure whose points, directions and rotations belong to the bodies of the loops' frames."""
        first, anchors = self.tree.model.njoints, self.closure.anchors
        frames = [self._frames.get(frame, -first) for frame in self.closure.direction_frames]
        joints = {
            "point_joint": first + np.arange(len(anchors.point_joint)),
            "direction_joint": first + np.array(frames),
        }

        def attach(group: Rows) -> Rows:
            if isinstance(group, RelativeLog):
                a, b = (first + self._frames_of(group, end) for end in ("frame_a", "frame_b"))
                return replace(group, joint_a=a, joint_b=b)
            return group

        groups = tuple(map(attach, self.closure.groups))
        return replace(self.closure, anchors=replace(anchors, **joints), groups=groups)

    def _frames_of(self, group: RelativeLog, end: str) -> IntArray:
        return np.array([self._frames[self._base.names[row][0], end] for row in group.out[::3]], dtype=np.intp)

    def _point_anchors(self, bodies: IntArray) -> Anchors:
        bodies, local = bodies[self._point_bodies], self._offset[self._point_bodies]
        return Anchors(bodies, local, np.zeros(0, dtype=np.intp), np.zeros((0, 3)))

    def _twists(self, placement: Array) -> Array:
        """Return how parameters move bodies (count, bodies, 6, p): as twists at the world's origin, in world axes."""
        rotation, origin = placement[..., :9].reshape(*placement.shape[:2], 3, 3).swapaxes(2, 3), placement[..., 9:]
        twist = np.zeros((len(placement), len(self._carriers), 6, len(self.names)))
        moved = (self._turn != 0).any(axis=(0, 2)) | (self._slide != 0).any(axis=(0, 2))
        for body, carrier in enumerate(self._carriers):
            if body in (0, carrier):
                continue
            twist[:, body] = twist[:, carrier]
            if moved[body]:
                at = rotation[:, carrier] @ self._offset[body] + origin[:, carrier]
                turn, slide = (rotation[:, carrier] @ x[:, body].T for x in (self._turn, self._slide))
                twist[:, body, :3] += slide + skew(at) @ turn
                twist[:, body, 3:] += turn
        return twist


class _ParameterPoses(ManyPoses):
    """Points and directions of bodies at many configurations. The columns of their Jacobians are parameters."""

    def __init__(self, geometry: Geometry, anchors: Anchors, q_tree: Array, twist: Array) -> None:
        super().__init__(geometry.tree, anchors, q_tree)
        joint = self._joints(geometry._axes)
        self.rotation, self.translation = self.rotation[joint], self.translation[joint]
        self.twist, self.bodies, self.columns = twist, twist.shape[1], twist.shape[3]

    @lazy
    def p_jacobian(self) -> Array:
        """Derivatives of the points, shape (count, 2 k, 3, p)."""
        twist = self.twist[:, self.anchors.point_joint]
        arms = skew(self.p.reshape(-1, 3)).reshape(*self.p.shape, 3)
        return np.asarray(twist[:, :, :3] - arms @ twist[:, :, 3:])

    def angular(self, joint: IntArray) -> Array:
        """Angular velocities of bodies, which are numbered across all copies, shape (len(joint), 3, p)."""
        return np.asarray(self.twist.reshape(-1, 6, self.columns)[joint, 3:])
