"""Springs, dampers and constant forces: their generalized forces, derivatives and energy."""

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
    """All springs, dampers and constant forces of a mechanism, and the viscous damping of its joints.

    Parameters
    ----------
    tree, frames : Tree, Frames
    specs : sequence of SpringSpec
    forces : sequence of ForceSpec

    Raises
    ------
    MechanismError, InputError
        An unknown frame or joint, a key that does not belong to the kind of spring, two springs on one joint.
    """

    def __init__(
        self, tree: Tree, frames: Frames, specs: Sequence[SpringSpec], forces: Sequence[ForceSpec] = ()
    ) -> None:
        self.tree = tree
        ends_a, ends_b, constants = [], [], []
        self.names = list[str]()  # of the springs between frames
        self._on_joint = set[int]()
        self.joint_stiffness, self.joint_rest = np.zeros(tree.n), np.zeros(tree.n)
        self.joint_damping = np.array(tree.model.damping, dtype=float)
        for k, spec in enumerate(specs):
            where = f"spring {k + 1}"
            if spec.joint is not None:
                _require_absent(where, "a spring on a joint", spec, ("frame_a", "frame_b", "rest_length"))
                self._add_joint(tree.joint_index(spec.joint, where), spec)
            elif spec.frame_a is not None and spec.frame_b is not None:
                _require_absent(where, "a spring between frames", spec, ("rest",))
                ends_a.append(frames.find(spec.frame_a, f"{where}, frame_a"))
                ends_b.append(frames.find(spec.frame_b, f"{where}, frame_b"))
                constants.append((spec.stiffness, spec.rest_length or 0.0, spec.damping))
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
        self.stiffness, self.rest_length, self.damping = np.array(constants).reshape(-1, 3).T
        self.between_frames = bool(constants)
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
        """Sum of the absolute contributions to `elastic_force`, shape (n,): the scale of its rounding errors."""
        sizes = np.abs(self.constant) + np.abs(self.joint_stiffness * (q_tree[self.tree.q_index] - self.joint_rest))
        if self.between_frames:
            length, length_jacobian = self._lengths(q_tree)
            sizes += np.abs(self.stiffness * (length - self.rest_length)) @ np.abs(length_jacobian)
        return np.asarray(sizes)

    def elastic_gradient(self, q_tree: Array) -> Array:
        """Tangent stiffness: minus the derivative of `elastic_force` by the tangent coordinates, shape (n, n).

        It includes the geometric stiffness, from the derivative of the Jacobian of the lengths.
        """
        gradient = np.diag(self.joint_stiffness)
        if not self.between_frames:
            return gradient
        length, length_jacobian = self._lengths(q_tree)
        gradient += length_jacobian.T @ (self.stiffness[:, None] * length_jacobian)
        pull = self.stiffness * (length - self.rest_length)
        for k, derivative in enumerate(self._length_hessian(q_tree)):
            gradient[:, k] += pull @ derivative
        return gradient

    def find_without_direction(self, q_tree: Array, min_length: float) -> list[str]:
        """Name the springs and dampers whose ends coincide, so that they have no direction to act along.

        Springs of rest length zero are not among them: their force is differentiable there.
        """
        if not self.between_frames:
            return []
        acts = (self.damping != 0.0) | ((self.stiffness != 0.0) & (self.rest_length != 0.0))
        return [self.names[k] for k in np.flatnonzero(acts & (self._lengths(q_tree)[0] <= min_length))]

    def damping_force(self, q_tree: Array, v_tree: Array) -> Array:
        """Generalized force of the dampers, shape (n,)."""
        force = -self.joint_damping * v_tree
        if self.damping.any():
            _, length_jacobian = self._lengths(q_tree)
            force -= (self.damping * (length_jacobian @ v_tree)) @ length_jacobian
        return force

    def body_wrenches(self, pose: Pose, v_tree: Array) -> Array:
        """Wrenches of springs and dampers between frames on the bodies of their frames.

        Parameters
        ----------
        pose : Pose
            Poses of the bodies.
        v_tree : (n,) array

        Returns
        -------
        (joints, 6) array
            Force, N, and moment about the world's origin, N m, in world axes, on the body of each joint; joint 0 is the
            world.
        """
        if not self.between_frames:
            return np.zeros((len(pose.translation), 6))
        length, length_jacobian = self._lengths(pose.q_tree)
        pull = self.stiffness * (length - self.rest_length) + self.damping * (length_jacobian @ v_tree)
        return -(pull @ _lengths_of_pairs(BodyPose(pose, self.anchors))[1]).reshape(-1, 6)

    def energy(self, q_tree: Array) -> float:
        """Potential energy of springs and constant forces, joules. A constant force has none at coordinate zero."""
        coordinates = q_tree[self.tree.q_index]
        energy = 0.5 * float(self.joint_stiffness @ (coordinates - self.joint_rest) ** 2)
        energy -= float(self.constant @ coordinates)
        if self.between_frames:
            length = np.sqrt(np.sum(Pose(self.tree, self.anchors, q_tree).r ** 2, axis=1))
            energy += 0.5 * float(self.stiffness @ (length - self.rest_length) ** 2)
        return energy

    def _length_hessian(self, q_tree: Array) -> Iterator[Array]:
        """Yield the derivative of the Jacobian of the lengths by each tangent coordinate, shape (k, n)."""
        pose = Pose(self.tree, self.anchors, q_tree)
        length, length_jacobian = self._lengths(q_tree)
        divisor = np.where(length > 0, length, 1.0)[:, None]
        for k in range(self.tree.n):
            rate = Rate(pose, np.eye(self.tree.n)[k])
            # d/dq_k of (r . r_jacobian / length); the last term is the derivative of the length
            product_dot = (rate.r_dot[:, None, :] @ pose.r_jacobian + pose.r[:, None, :] @ rate.r_jacobian_dot)[:, 0, :]
            yield (product_dot - length_jacobian * length_jacobian[:, k : k + 1]) / divisor

    def _lengths(self, q_tree: Array) -> tuple[Array, Array]:
        """Return the lengths (k,) and their Jacobian (k, n)."""
        return _lengths_of_pairs(Pose(self.tree, self.anchors, q_tree))


def _lengths_of_pairs(pose: Pose) -> tuple[Array, Array]:
    """Return the lengths of pairs of points, shape (k,), and their Jacobian, which is zero for length zero."""
    length = np.sqrt(np.sum(pose.r**2, axis=1))
    direction = pose.r / np.where(length > 0, length, 1.0)[:, None]
    return length, (direction[:, None, :] @ pose.r_jacobian)[:, 0, :]


def _require_absent(where: str, kind: str, spec: SpringSpec, keys: tuple[str, ...]) -> None:
    for key in keys:
        if getattr(spec, key) is not None:
            raise InputError(f"{where}: {kind} has no key {key!r}")
