"""Points and directions of loops in world axes, their Jacobians, and the time derivatives of the Jacobians."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray, lazy
from ckc_pin.mechanism.tree import Tree

__all__ = ["Anchors", "BodyPose", "Pose", "Rate", "cross", "dot_rows"]

# _LEVI_CIVITA[3 * b + i, a] = epsilon_iab, so that (omega x p)_i = sum_ab epsilon_iab omega_a p_b
_LEVI_CIVITA = np.zeros((9, 3))
for _i in range(3):
    _a, _b = (_i + 1) % 3, (_i + 2) % 3
    _LEVI_CIVITA[3 * _b + _i, _a] = 1.0
    _LEVI_CIVITA[3 * _a + _i, _b] = -1.0


MIN_WRENCH_SIZE = 100  # coordinates from which Jacobians of points cost more than wrenches


def dot_rows(e: Array, jacobian: Array) -> Array:
    """Return the rows e_i . J_i of vectors (k, 3) and Jacobians (k, 3, n)."""
    return np.asarray((e[:, None, :] @ jacobian)[:, 0, :])


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors (..., 3). For a few vectors `np.cross` takes ten times as long."""
    c = np.empty(np.broadcast_shapes(a.shape, b.shape))
    c[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    c[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    c[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return c


class Anchors(Immutable, frozen=True):
    """Pairs of points and directions that constraint rows refer to, each fixed to a joint (0 is the world).

    Attributes
    ----------
    point_joint, point_local : (2 k,) and (2 k, 3) arrays
        Joint and position in it of the k points A, then of the k points B.
    direction_joint, direction_local : (m,) and (m, 3) arrays
    """

    point_joint: IntArray
    point_local: Array
    direction_joint: IntArray
    direction_local: Array


class Pose:
    """Points and directions of loops at one configuration, with their Jacobians. It holds copies of Pinocchio's data.

    Parameters
    ----------
    tree : Tree
    anchors : Anchors
    q_tree : (nq,) array
    """

    def __init__(self, tree: Tree, anchors: Anchors, q_tree: Array) -> None:
        self.tree = tree
        self.anchors = anchors
        self.q_tree = q_tree
        placement, jacobian = tree.kinematics(q_tree)
        self.rotation = placement[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        self.translation = placement[:, 9:]
        self.linear_part = jacobian[:3]
        self.angular_part = jacobian[3:]

    @property
    def support(self) -> Array:
        """1 where a column of a Jacobian moves a joint, otherwise 0, shape (joints, 1, columns)."""
        return self.tree.support

    @lazy
    def p(self) -> Array:
        """Positions of the points in the world, shape (2 k, 3), metres."""
        at = self.anchors.point_joint
        return (self.rotation[at] @ self.anchors.point_local[:, :, None])[:, :, 0] + self.translation[at]

    @lazy
    def r(self) -> Array:
        """Differences p_A - p_B, shape (k, 3)."""
        k = len(self.p) // 2
        return self.p[:k] - self.p[k:]

    @lazy
    def lever(self) -> Array:
        """Matrix (3, 3 n) for which p @ lever is omega x p for each column of the Jacobian."""
        return (_LEVI_CIVITA @ self.angular_part).reshape(3, -1)

    @lazy
    def p_jacobian(self) -> Array:
        """Jacobians of the points, shape (2 k, 3, n)."""
        moved = (self.p @ self.lever).reshape(len(self.p), 3, -1) + self.linear_part
        return self.support[self.anchors.point_joint] * moved

    def p_motions(self, tangent: Array) -> Array:
        """Velocities of the points for columns of v' (n, d), shape (6 k, d)."""
        motions = self.tree.body_motions(self.q_tree, tangent)[self.anchors.point_joint]
        velocities = motions[:, :3] + np.cross(motions[:, 3:], self.p[:, :, None], axis=1)
        return velocities.reshape(3 * len(motions), tangent.shape[1])

    @lazy
    def r_jacobian(self) -> Array:
        """Jacobians of the differences, shape (k, 3, n)."""
        k = len(self.p) // 2
        return self.p_jacobian[:k] - self.p_jacobian[k:]

    def project_r_jacobian(self, pair: IntArray, e: Array) -> Array:
        """Return the rows e_i . d r_i / dq' of vectors e (k, 3), shape (k, n).

        The Jacobians of r of a large mechanism are left out: a vector at a point is a wrench, whose moment about the
        world's origin multiplies the angular part.
        """
        if self.tree.n < MIN_WRENCH_SIZE:
            return dot_rows(e, self.r_jacobian[pair])
        k = len(self.p) // 2
        rows = np.zeros((len(pair), self.linear_part.shape[1]))
        for sign, at in ((1.0, pair), (-1.0, k + pair)):
            wrench = sign * np.hstack([e, cross(self.p[at], e)])
            moved = wrench @ np.vstack([self.linear_part, self.angular_part])
            moved *= self.support[self.anchors.point_joint[at], 0]
            rows += moved
        return rows

    def project_e_angular(self, direction: IntArray, torque: Array) -> Array:
        """Return the rows torque_i . d omega_i / dv' of the joints that directions are fixed to, shape (k, n)."""
        if self.tree.n < MIN_WRENCH_SIZE:
            return dot_rows(torque, self.e_angular[direction])
        return np.asarray(self.support[self.anchors.direction_joint[direction], 0] * (torque @ self.angular_part))

    @lazy
    def e(self) -> Array:
        """Directions in world axes, shape (m, 3)."""
        at = self.anchors.direction_joint
        return (self.rotation[at] @ self.anchors.direction_local[:, :, None])[:, :, 0]

    @lazy
    def e_angular(self) -> Array:
        """Angular Jacobians of the joints that the directions are fixed to, shape (m, 3, n)."""
        return self.angular(self.anchors.direction_joint)

    def angular(self, joint: IntArray) -> Array:
        """Angular Jacobians of joints, shape (k, 3, n)."""
        return self.support[joint] * self.angular_part


class BodyPose(Pose):
    """A pose whose Jacobians are with respect to the spatial velocities of all bodies, the world's included.

    Columns 6 k to 6 k + 5 belong to the body of joint k: its linear velocity at the world's origin, then its angular
    velocity, in world axes. The transposed Jacobian times the multipliers of the rows is the wrench on each body: force
    and moment about the origin.

    Parameters
    ----------
    pose : Pose
        Poses of the bodies.
    anchors : Anchors
        Points and directions to differentiate.
    """

    def __init__(self, pose: Pose, anchors: Anchors) -> None:
        self.tree, self.anchors, self.q_tree = pose.tree, anchors, pose.q_tree
        self.rotation, self.translation = pose.rotation, pose.translation

    @lazy
    def linear_part(self) -> Array:
        """Linear velocities at the world's origin of all bodies, shape (3, 6 joints)."""
        return np.tile(np.eye(3, 6), len(self.translation))

    @lazy
    def angular_part(self) -> Array:
        """Angular velocities of all bodies, shape (3, 6 joints)."""
        return np.tile(np.eye(3, 6, 3), len(self.translation))

    @lazy
    def support(self) -> Array:
        """1 where a column belongs to the body, shape (joints, 1, 6 joints)."""
        return np.repeat(np.eye(len(self.translation)), 6, axis=1)[:, None, :]

    def project_r_jacobian(self, pair: IntArray, e: Array) -> Array:
        """Return the rows e_i . d r_i of vectors e (k, 3), shape (k, 6 joints).

        They are the wrenches of a force e on the body of A and of -e on that of B.
        """
        half, row = len(self.p) // 2, np.arange(len(pair))
        wrenches = np.zeros((len(pair), len(self.translation), 6))
        for sign, at in ((1.0, pair), (-1.0, half + pair)):
            wrenches[row, self.anchors.point_joint[at]] += sign * np.hstack([e, cross(self.p[at], e)])
        return wrenches.reshape(len(pair), -1)

    def project_e_angular(self, direction: IntArray, torque: Array) -> Array:
        """Return the rows torque_i . d omega_i of the bodies that directions are fixed to, shape (k, 6 joints)."""
        wrenches = np.zeros((len(direction), len(self.translation), 6))
        wrenches[np.arange(len(direction)), self.anchors.direction_joint[direction], 3:] = torque
        return wrenches.reshape(len(direction), -1)

    def angular(self, joint: IntArray) -> Array:
        """Angular Jacobians of bodies, shape (k, 3, 6 joints)."""
        jacobians = np.zeros((len(joint), 3, len(self.translation), 6))
        jacobians[np.arange(len(joint)), :, joint, 3:] = np.eye(3)
        return jacobians.reshape(len(joint), 3, -1)


class Rate:
    """Time derivatives of the points, directions and Jacobians of a pose along a velocity.

    Parameters
    ----------
    pose : Pose
    v : (n,) array
        Any tangent velocity v'; it need not satisfy the loops.
    """

    def __init__(self, pose: Pose, v: Array) -> None:
        self.pose = pose
        self.v = v
        jacobian_dot = pose.tree.jacobian_dot(pose.q_tree, v)
        self.linear_part = jacobian_dot[:3]
        self.angular_part = jacobian_dot[3:]

    @lazy
    def r_dot(self) -> Array:
        """Time derivatives of the differences, shape (k, 3)."""
        return self.pose.r_jacobian @ self.v

    @lazy
    def r_jacobian_dot(self) -> Array:
        """Time derivative of `Pose.r_jacobian`, shape (k, 3, n)."""
        pose = self.pose
        p_dot = pose.p_jacobian @ self.v
        lever_dot = (_LEVI_CIVITA @ self.angular_part).reshape(3, -1)
        moved = (pose.p @ lever_dot + p_dot @ pose.lever).reshape(len(p_dot), 3, -1) + self.linear_part
        moved *= pose.tree.support[pose.anchors.point_joint]
        k = len(p_dot) // 2
        return moved[:k] - moved[k:]

    @lazy
    def e_dot(self) -> Array:
        """Time derivatives of the directions, shape (m, 3)."""
        return cross(self.pose.e_angular @ self.v, self.pose.e)

    @lazy
    def e_angular_dot(self) -> Array:
        """Time derivative of `Pose.e_angular`, shape (m, 3, n)."""
        return self.angular_dot(self.pose.anchors.direction_joint)

    def angular_dot(self, joint: IntArray) -> Array:
        """Time derivative of angular Jacobians of joints, shape (k, 3, n)."""
        return self.pose.tree.support[joint] * self.angular_part
