"""What each coordinate changes of a motion: bodies, points and directions with their rates and accelerations.

World axes throughout. With S_k the column of coordinate k of the world Jacobian, V_i and A_i the velocity and the
acceleration of body i and p(k) the body that coordinate k's joint is fixed to,

    dS_j / dq_k = S_k x S_j                               where k moves j's joint,
    dV_i / dq_k = S_k x (V_i - V_p(k))                    where k moves body i,
    dA_i / dq_k = S_k x (A_i - A_p(k)) + S_dot_k x (V_i - V_p(k)) - (dV_i / dq) [v, .]_k.

The last term is that of tangent coordinates that do not commute, which only a free root has.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.mechanism.lazy import lazy
from ckc_pin.mechanism.pose import Pose, Rate, cross
from ckc_pin.mechanism.tree import Array, IntArray

__all__ = ["Variation"]


class Variation:
    """A motion through a pose, v' and its rate a given, and its derivatives along all tangent coordinates.

    Parameters
    ----------
    pose : Pose
    v : (n,) array
        Tangent velocity, on or off the closure.
    a : (n,) array
        Its rate.
    """

    def __init__(self, pose: Pose, v: Array, a: Array) -> None:
        self.pose, self.v, self.a = pose, v, a
        tree, S, rate = pose.tree, _columns(pose), Rate(pose, v)
        S_dot = np.vstack([rate.linear_part, rate.angular_part])
        moves = tree.support[:, 0]
        self._velocity = moves @ (S * v).T
        self._acceleration = moves @ (S * a + S_dot * v).T
        below = tree.carrier
        sweep = [(x[:, :, None] - x[below].T[None]) * moves[:, None] for x in (self._velocity, self._acceleration)]
        self._velocity_gradient = _motion_cross(S, sweep[0])
        self._acceleration_gradient = _motion_cross(S, sweep[1]) + _motion_cross(S_dot, sweep[0])
        if tree.free:
            self._acceleration_gradient -= self._velocity_gradient @ tree.bracket(v)

    # --- bodies ----------------------------------------------------------------------------------

    def spin(self, joint: IntArray) -> tuple[Array, Array]:
        """Angular velocity and acceleration of joints' bodies, shape (k, 3) each."""
        return self._velocity[joint, 3:], self._acceleration[joint, 3:]

    def spin_gradient(self, joint: IntArray) -> tuple[Array, Array]:
        """Their derivatives, shape (k, 3, n) each."""
        return self._velocity_gradient[joint, 3:], self._acceleration_gradient[joint, 3:]

    # --- points and directions of the pose's anchors ---------------------------------------------

    @lazy
    def r(self) -> tuple[Array, Array]:
        """Rate and acceleration of the differences p_A - p_B, shape (k, 3) each."""
        return _differences(self._p_rates)

    @lazy
    def r_gradient(self) -> tuple[Array, Array]:
        """Derivatives of `r`, shape (k, 3, n) each; of the differences themselves it is `Pose.r_jacobian`."""
        pose, at = self.pose, self.pose.anchors.point_joint
        omega, alpha = self.spin(at)
        omega_gradient, alpha_gradient = self.spin_gradient(at)
        p, p_dot, moved = pose.p, self._p_rates[0], pose.p_jacobian
        rate = self._velocity_gradient[at, :3] + _cross(omega_gradient, p) + _cross(omega, moved)
        return _differences(
            (
                rate,
                self._acceleration_gradient[at, :3]
                + (_cross(alpha_gradient, p) + _cross(alpha, moved))
                + (_cross(omega_gradient, p_dot) + _cross(omega, rate)),
            )
        )

    @lazy
    def _p_rates(self) -> tuple[Array, Array]:
        at = self.pose.anchors.point_joint
        omega, alpha = self.spin(at)
        p_dot = self._velocity[at, :3] + cross(omega, self.pose.p)
        return p_dot, self._acceleration[at, :3] + cross(alpha, self.pose.p) + cross(omega, p_dot)

    @lazy
    def e(self) -> tuple[Array, Array]:
        """Rate and acceleration of the directions, shape (m, 3) each."""
        omega, alpha = self.spin(self.pose.anchors.direction_joint)
        e_dot = cross(omega, self.pose.e)
        return e_dot, cross(alpha, self.pose.e) + cross(omega, e_dot)

    @lazy
    def e_gradient(self) -> tuple[Array, Array, Array]:
        """Derivatives of the directions, of their rates and accelerations, shape (m, 3, n) each."""
        at, e, e_dot = self.pose.anchors.direction_joint, self.pose.e, self.e[0]
        omega, alpha = self.spin(at)
        omega_gradient, alpha_gradient = self.spin_gradient(at)
        moved = _cross(self.pose.e_angular, e)
        rate = _cross(omega_gradient, e) + _cross(omega, moved)
        return (
            moved,
            rate,
            (_cross(alpha_gradient, e) + _cross(alpha, moved)) + (_cross(omega_gradient, e_dot) + _cross(omega, rate)),
        )


def _columns(pose: Pose) -> Array:
    return np.vstack([pose.linear_part, pose.angular_part])


def _cross(a: Array, b: Array) -> Array:
    """Cross products of (k, 3, n) and (k, 3), either way round."""
    return cross(a if a.ndim == 3 else a[:, :, None], b if b.ndim == 3 else b[:, :, None])


def _motion_cross(S: Array, X: Array) -> Array:
    """Spatial cross products S_k x X[:, :, k] of motions, linear part first: shape (bodies, 6, n)."""
    linear, angular = S[None, :3], S[None, 3:]
    return np.concatenate([cross(angular, X[:, :3]) + cross(linear, X[:, 3:]), cross(angular, X[:, 3:])], axis=1)


def _differences(both: tuple[Array, Array]) -> tuple[Array, Array]:
    k = len(both[0]) // 2
    return both[0][:k] - both[0][k:], both[1][:k] - both[1][k:]
