"""Names, numbers, rotations and frames: what all readers of foreign formats share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.spec import Frame, FrameSpec, Vector3

__all__ = [
    "choose_name",
    "from_axis_angle",
    "from_quaternion",
    "from_rpy",
    "list_names",
    "make_frame",
    "make_unique",
    "require_direction",
    "round_number",
    "round_vector",
    "to_rpy",
]

GENERIC_NAMES = (
    "robot",
    "model",
    "scene",
    "main",
    "urdf",
    "mjcf",
    "sdf",
    "xml",
    "robots",
)  # do not identify a mechanism
MAX_NAME_CHARACTERS = 80
MAX_LISTED_NAMES = 6  # in one message
ZERO_TOLERANCE = 1e-15  # smaller lengths (m) and angles (rad) are rounding errors of a conversion


# --- names and frames ----------------------------------------------------------------------------------------------


def make_frame(link: str, pose: pin.SE3) -> Frame:
    """Return a frame at a pose in a link; only the link's name where the pose is the identity."""
    xyz, rpy = round_vector(pose.translation), round_vector(to_rpy(pose.rotation))
    return FrameSpec(link=link, xyz=xyz, rpy=rpy) if any((*xyz, *rpy)) else link


def choose_name(path: Path, declared: str = "") -> str:
    """Name a mechanism after its file, or after its folder or its declared name where the file's name is generic."""
    folders = path.absolute().parents
    for candidate in (
        path.stem.removesuffix(".urdf").removesuffix(".sdf"),
        folders[0].name,
        declared,
        folders[min(1, len(folders) - 1)].name,
    ):
        cleaned = re.sub(r"[^\w-]+", "_", candidate).strip("_-")[:MAX_NAME_CHARACTERS]
        if cleaned and cleaned.lower() not in GENERIC_NAMES:
            return cleaned
    return "imported"


def list_names(names: Sequence[str]) -> str:
    """Return the first names as text, with the number of names that are not listed."""
    omitted = len(names) - MAX_LISTED_NAMES
    return ", ".join(names[:MAX_LISTED_NAMES]) + (f" and {omitted} more" if omitted > 0 else "")


def make_unique(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number appended if it is already taken."""
    used = set(taken)
    return next(n for n in (name, *(f"{name}_{k}" for k in range(2, len(used) + 3))) if n not in used)


# --- numbers -------------------------------------------------------------------------------------------------------


def round_number(x: float) -> float:
    """Round a length or angle to 15 digits, which removes the rounding errors of a conversion.

    Masses and inertias are not rounded: small ones are not errors.
    """
    return 0.0 if abs(x) < ZERO_TOLERANCE else float(f"{x:.15g}")


def round_vector(values: Iterable[float]) -> Vector3:
    """Return three numbers, rounded by `round_number`."""
    x, y, z = (round_number(float(value)) for value in values)
    return (x, y, z)


def require_direction(values: Iterable[float], where: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return a direction, not normalized.

    Raises
    ------
    InputError
        All three numbers are zero.
    """
    direction = np.array([float(x) for x in values])
    if not np.linalg.norm(direction) > 0:
        raise InputError(f"{where}: expected a direction, got {direction.tolist()}")
    return direction


# --- rotations -----------------------------------------------------------------------------------------------------


def from_quaternion(quaternion: Sequence[float] | Array) -> Array:
    """Return the rotation matrix of a quaternion (w, x, y, z), which need not be normalized."""
    return np.array(pin.Quaternion(*map(float, quaternion)).normalized().matrix())


def from_axis_angle(axis: Array, angle: float) -> Array:
    """Return the rotation matrix for an angle (rad) about an axis, which need not be normalized."""
    return np.array(pin.AngleAxis(float(angle), np.asarray(axis, dtype=float) / np.linalg.norm(axis)).matrix())


def from_rpy(rpy: Sequence[float]) -> Array:
    """Return the rotation matrix of a URDF's roll, pitch and yaw (rad)."""
    return np.array(pin.rpy.rpyToMatrix(*map(float, rpy)))


def to_rpy(rotation: Array) -> tuple[float, float, float]:
    """Return a URDF's roll, pitch and yaw (rad) of a rotation matrix.

    At a pitch of +-90 degrees only the sum or difference of roll and yaw is determined; one of the solutions is
    returned.
    """
    roll, pitch, yaw = map(float, pin.rpy.matrixToRpy(np.ascontiguousarray(rotation)))
    return roll, pitch, yaw
