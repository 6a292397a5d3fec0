"""Rotations as other formats write them, to matrices, and back to a URDF's roll, pitch and yaw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array

__all__ = ["from_axis_angle", "from_quaternion", "from_rpy", "to_rpy"]


def from_quaternion(quaternion: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero."""
    return np.array(pin.Quaternion(*map(float, quaternion)).normalized().matrix())


def from_axis_angle(axis: Array, angle: float) -> Array:
    """Rotation by an angle about an axis of any length but zero."""
    return np.array(pin.AngleAxis(float(angle), np.asarray(axis, dtype=float) / np.linalg.norm(axis)).matrix())


def from_rpy(rpy: Sequence[float]) -> Array:
    """Rotation of a URDF's roll, pitch and yaw."""
    return np.array(pin.rpy.rpyToMatrix(*map(float, rpy)))


def to_rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw; where yaw and roll turn about the same axis any of them."""
    roll, pitch, yaw = map(float, pin.rpy.matrixToRpy(np.ascontiguousarray(rotation)))
    return roll, pitch, yaw
