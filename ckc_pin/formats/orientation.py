"""Rotations as other formats write them, to matrices, and back to a URDF's roll, pitch and yaw."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ckc_pin.mechanism.tree import Array

__all__ = ["euler", "from_axis_angle", "from_quaternion", "from_rpy", "from_x_and_y", "from_z", "to_rpy"]


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


def from_x_and_y(x: Array, y: Array) -> Array:
    """Rotation whose x axis is along x, its y axis in the plane of x and y."""
    e1 = x / np.linalg.norm(x)
    e2 = y - e1 * (e1 @ y)
    e2 = e2 / np.linalg.norm(e2)
    return np.column_stack([e1, e2, np.cross(e1, e2)])


def from_z(z: Array) -> Array:
    """Smallest rotation that takes (0, 0, 1) to the direction z."""
    axis = np.array([-z[1], z[0], 0.0])  # the cross product of (0, 0, 1) and z
    sine = float(np.linalg.norm(axis))
    if sine < 1e-10 * np.linalg.norm(z):
        axis = np.array([1.0, 0.0, 0.0])
    return from_axis_angle(axis, math.atan2(sine, z[2]))


def euler(angles: Sequence[float], sequence: str) -> Array:
    """Rotation of three turns: about axes that turn along (xyz), or that stay (XYZ)."""
    rotation = np.eye(3)
    for angle, letter in zip(angles, sequence, strict=True):
        turn = from_axis_angle(np.eye(3)["xyz".index(letter.lower())], angle)
        rotation = rotation @ turn if letter.islower() else turn @ rotation
    return rotation


def from_rpy(rpy: Sequence[float]) -> Array:
    """Rotation of a URDF's roll, pitch and yaw."""
    return euler(rpy, "XYZ")


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
