"""Rotations as other formats write them, to matrices, and back to a URDF's roll, pitch and yaw."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ckc_pin.mechanism.tree import Array

__all__ = ["from_axis_angle", "from_quaternion", "from_rpy", "to_rpy"]


def from_quaternion(quaternion: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def from_axis_angle(axis: Array, angle: float) -> Array:
    """Rotation by an angle about an axis of any length but zero."""
    half = angle / 2
    return from_quaternion([math.cos(half), *(math.sin(half) * axis / np.linalg.norm(axis))])


def from_rpy(rpy: Sequence[float]) -> Array:
    """Rotation of a URDF's roll, pitch and yaw."""
    x, y, z = (from_axis_angle(axis, angle) for axis, angle in zip(np.eye(3), rpy, strict=True))
    return z @ y @ x


def to_rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw, exact to rounding for pitches near 90 degrees too.

    Yaw is fixed first and the others read off what it leaves, so where yaw and roll turn about the
    same axis any yaw will do.
    """
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-rotation[2, 0], c * rotation[0, 0] + s * rotation[1, 0])
    roll = math.atan2(s * rotation[0, 2] - c * rotation[1, 2], -s * rotation[0, 1] + c * rotation[1, 1])
    return roll, pitch, yaw
