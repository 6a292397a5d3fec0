"""Springs and dampers between frames or on joints, constant forces: forces on the tree, and what they store."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.pose import Anchors, BodyPose, Pose, Rate
from ckc_pin.mechanism.spec import ForceSpec, SpringSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Springs"]


class Springs:
    """All springs, dampers and constant forces of a mechanism, with the viscous damping of the URDF's joints.

    Parameters
    ----------
    tree, frames : Tree, Frames
    specs : sequence of SpringSpec
    forces : sequence of ForceSpec

    Raises
    ------
    MechanismError, InputError
        An unknown frame or joint, or a spring that is neither of the two kinds.
    """

    def __init__(
        self, tree: Tree, frames: Frames, specs: Sequence[SpringSpec], forces: Sequence[ForceSpec] = ()
    ) -> None:
        self.tree = tree
        ends_a, ends_b, lines = [], [], []
        self.names = list[str]()  # of those between frames
        self._on_joint = set[int]()
        self.joint_stiffness, self.joint_rest = np.zeros(tree.n), np.zeros(tree.n)
        self.joint_damping = np.array(tree.model.damping, dtype=float)
        for k, spec in enumerate(specs):
            where = f"spring {k + 1}"
            if spec.joint is not None:
                _forbid(where, "a spring on a joint", spec, ("frame_a", "frame_b", "rest_length"))
                self._add_joint(tree.joint_index(spec.joint, where), spec)
            elif spec.frame_a is not None and spec.frame_b is not None:
                _forbid(where, "a spring between frames", spec, ("rest",))
                ends_a.append(frames.find(spec.frame_a, f"{where}, frame_a"))
                ends_b.append(frames.find(spec.frame_b, f"{where}, frame_b"))
                lines.append((spec.stiffness, spec.rest_length or 0.0, spec.damping))
                self.names.append(where)
            else:
                raise InputError(f"{where}: give either joint, or frame_a and frame_b")
        self.constant = np.zeros(tree.n)
        for k, force in enumerate(forces):
            self.constant[tree.joint_index(force.joint, f"force {k + 1}")] += force.value
        ends = [*ends_a, *ends_b]
        empty = np.zeros(0, np.intp)
        self.anchors = Anchors(
            np.array([f.joint for f in ends], np.intp),
            np.array([f.translation for f in ends]).reshape(-1, 3),
            empty,
            np.zeros((0, 3)),
        )
        self.stiffness, self.rest_length, self.damping = np.array(lines).reshape(-1, 3).T
        self.between_frames = bool(lines)
        self.any = any(bool(x.any()) for x in (self.stiffness, self.joint_stiffness, self.constant))
        self.any_damping = bool(self.damping.any()) or bool(self.joint_damping.any())

    def _add_joint(self, at: int, spec: SpringSpec) -> None:
        if at in self._on_joint:
            raise MechanismError(f"two springs on joint {spec.joint!r}; give one with their stiffness and damping")
        self._on_joint.add(at)
        self.joint_stiffness[at] = spec.stiffness
        self.joint_rest[at] = spec.rest or 0.0
        self.joint_damping[at] += spec.damping

    def elastic_force(self, q_tree: Array) -> Array:
        """Generalized force of springs and constant forces, shape (n,): minus the gradient of `energy`."""
        force = self.constant - self.joint_stiffness * (q_tree[self.tree.q_index] - self.joint_rest)
        if self.between_frames:
            length, length_jacobian = self._lengths(q_tree)
            force -= (self.stiffness * (length - self.rest_length)) @ length_jacobian
        return force

    def sizes(self, q_tree: Array) -> Array:
        """What `elastic_force` would be if nothing in it acted against anything else, shape (n,): never negative."""
        sizes = np.abs(self.constant) + np.abs(self.joint_stiffness * (q_tree[self.tree.q_index] - self.joint_rest))
        if self.between_frames:
            length, length_jacobian = self._lengths(q_tree)
            sizes += np.abs(self.stiffness * (length - self.rest_length)) @ np.abs(length_jacobian)
        return np.asarray(sizes)

    def elastic_gradient(self, q_tree: Array) -> Array:
        """Minus the derivative of `elastic_force` along the tangent coordinates, shape (n, n).

        The geometric part is how the lengths' Jacobian changes along each coordinate.
        """
        gradient = np.diag(self.joint_stiffness)
        if not self.between_frames:
            return gradient
        length, length_jacobian = self._lengths(q_tree)
        gradient += length_jacobian.T @ (self.stiffness[:, None] * length_jacobian)
        pull = self.stiffness * (length - self.rest_length)
        for k, bent in enumerate(self._bending(q_tree)):
            gradient[:, k] += pull @ bent
        return gradient

    def without_direction(self, q_tree: Array, least: float) -> list[str]:
        """Name those whose ends are so near to each other that they have no direction to act along.

        Springs without a length at rest have a force and derivatives there, too.
        """
        if not self.between_frames:
            return []
        acts = (self.damping != 0.0) | ((self.stiffness != 0.0) & (self.rest_length != 0.0))
        return [self.names[k] for k in np.flatnonzero(acts & (self._lengths(q_tree)[0] <= least))]

    def damping_force(self, q_tree: Array, v_tree: Array) -> Array:
        """Generalized force of the dampers on the tree, shape (n,)."""
        force = -self.joint_damping * v_tree
        if self.damping.any():
            _, length_jacobian = self._lengths(q_tree)
            force -= (self.damping * (length_jacobian @ v_tree)) @ length_jacobian
        return force

    def body_wrenches(self, pose: Pose, v_tree: Array) -> Array:
        """What springs and dampers between frames do to the bodies that they hold on to.

        Parameters
        ----------
        pose : Pose
            Where the bodies are.
        v_tree : (n,) array

        Returns
        -------
        (joints, 6) array
            Force, N, and moment about the world's origin, N m, in world axes, on the body of each joint; 0: the world.
        """
        if not self.between_frames:
            return np.zeros((len(pose.translation), 6))
        length, length_jacobian = self._lengths(pose.q_tree)
        pull = self.stiffness * (length - self.rest_length) + self.damping * (length_jacobian @ v_tree)
        return -(pull @ _stretching(BodyPose(pose, self.anchors))[1]).reshape(-1, 6)

    def energy(self, q_tree: Array) -> float:
        """Energy stored, joules; what a constant force has left to give counts, zero at coordinate zero."""
        coordinates = q_tree[self.tree.q_index]
        energy = 0.5 * float(self.joint_stiffness @ (coordinates - self.joint_rest) ** 2)
        energy -= float(self.constant @ coordinates)
        if self.between_frames:
            length = np.sqrt(np.sum(Pose(self.tree, self.anchors, q_tree).r ** 2, axis=1))
            energy += 0.5 * float(self.stiffness @ (length - self.rest_length) ** 2)
        return energy

    def _bending(self, q_tree: Array) -> Iterator[Array]:
        """Derivative of the lengths' Jacobian along each tangent coordinate, (k, n) each."""
        pose = Pose(self.tree, self.anchors, q_tree)
        length, length_jacobian = self._lengths(q_tree)
        along = np.where(length > 0, length, 1.0)[:, None]
        for k in range(self.tree.n):
            rate = Rate(pose, np.eye(self.tree.n)[k])
            # d/dq_k of (r . r_jacobian / length), the stretching of length itself taken off
            turned = (rate.r_dot[:, None, :] @ pose.r_jacobian + pose.r[:, None, :] @ rate.r_jacobian_dot)[:, 0, :]
            yield (turned - length_jacobian * length_jacobian[:, k : k + 1]) / along

    def _lengths(self, q_tree: Array) -> tuple[Array, Array]:
        """Lengths (k,) and their Jacobian (k, n)."""
        return _stretching(Pose(self.tree, self.anchors, q_tree))


def _stretching(pose: Pose) -> tuple[Array, Array]:
    """Lengths of the pairs (k,) and their Jacobian; a spring of length zero has no direction to pull in."""
    length = np.sqrt(np.sum(pose.r**2, axis=1))
    along = pose.r / np.where(length > 0, length, 1.0)[:, None]
    return length, (along[:, None, :] @ pose.r_jacobian)[:, 0, :]


def _forbid(where: str, kind: str, spec: SpringSpec, keys: tuple[str, ...]) -> None:
    for key in keys:
        if getattr(spec, key) is not None:
            raise InputError(f"{where}: {kind} has no key {key!r}")
