"""Rotations and cross products over arrays with any leading axes, independent of the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "IntArray", "apply", "cross", "dot", "perpendicular", "rotation", "rotation_vector", "rpy", "turn"]

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def cross(a: Array, b: Array) -> Array:
    """Return the cross product along the last axis. np.cross takes several times as long on small arrays."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a1 * b2 - a2 * b1
    out[..., 1] = a2 * b0 - a0 * b2
    out[..., 2] = a0 * b1 - a1 * b0
    return out


def dot(a: Array, b: Array) -> Array:
    """Return the scalar product along the last axis."""
    return np.einsum("...i,...i->...", a, b)


def apply(R: Array, a: Array) -> Array:
    """Return R a along the last axes."""
    return (R @ a[..., None])[..., 0]


def rpy(angles: Array | list[float] | tuple[float, float, float]) -> Array:
    """Return the rotation matrix of URDF's roll, pitch and yaw: about the fixed x, y and z axes in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def turn(axis: Array, angle: Array) -> Array:
    """Return rotations (P, 3, 3) by angles (P,) about one unit axis (3,)."""
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * K + (1 - c) * (K @ K)


def rotation(vector: Array) -> Array:
    """Return rotation matrices (P, 3, 3) of rotation vectors (P, 3)."""
    angle = np.linalg.norm(vector, axis=1)
    a = vector / np.where(angle > 0, angle, 1.0)[:, None]
    K = np.zeros((len(a), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -a[:, 2], a[:, 1], -a[:, 0]
    K -= np.swapaxes(K, 1, 2)
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * K + (1 - c) * (K @ K)


def rotation_vector(R: Array) -> Array:
    """Return rotation vectors (P, 3) of rotation matrices (P, 3, 3) well below half a turn."""
    s = 0.5 * np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)
    sine, cosine = np.linalg.norm(s, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1)
    angle = np.arctan2(sine, cosine)
    return s * np.where(sine > 1e-12, angle / np.where(sine > 0, sine, 1.0), 1.0)[:, None]


def perpendicular(a: Array) -> tuple[Array, Array]:
    """Return e1 and e2 perpendicular to the axis a, as defined in docs/reference/mechanism.md.

    For a coordinate axis they are the next two. Otherwise e1 = a x (the coordinate axis least aligned with a).
    """
    main = int(np.argmax(np.abs(a)))
    if a[main] > 0 and np.count_nonzero(a) == 1:
        return np.eye(3)[(main + 1) % 3], np.eye(3)[(main + 2) % 3]
    e1 = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(a, e1)
