"""The ten inertial numbers of a body as a symmetric 4 x 4 matrix, its pseudo-inertia.

    P = [[S, m c], [(m c)^T, m]],    S = tr(I) / 2 - I,

with the inertia I about the origin of the frame. A body with this inertia exists if and only if P is positive
semidefinite. Wensing, Kim, Slotine: Linear matrix inequalities for physically consistent inertial parameter
identification, IEEE Robotics and Automation Letters 3 (2018).
"""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array

__all__ = ["MOMENTS", "basis", "from_pseudo_inertia", "move", "pseudo_inertia"]

# The ten numbers in Pinocchio's order: mass, first moment, and inertia about the origin.
MOMENTS = ("mass", "moment.x", "moment.y", "moment.z", "origin_inertia.ixx", "origin_inertia.ixy",
           "origin_inertia.iyy", "origin_inertia.ixz", "origin_inertia.iyz", "origin_inertia.izz")  # fmt: skip
_AT = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # of the entries of the inertia


def pseudo_inertia(moments: Array) -> Array:
    """Return the pseudo-inertia (4, 4) of ten inertial numbers."""
    inertia = np.zeros((3, 3))
    for (i, j), x in zip(_AT, moments[4:], strict=True):
        inertia[i, j] = inertia[j, i] = x
    matrix = np.empty((4, 4))
    matrix[:3, :3] = np.trace(inertia) / 2 * np.eye(3) - inertia
    matrix[:3, 3] = matrix[3, :3] = moments[1:4]
    matrix[3, 3] = moments[0]
    return matrix


def from_pseudo_inertia(matrix: Array) -> Array:
    """Return the ten inertial numbers of a pseudo-inertia (4, 4)."""
    inertia = np.trace(matrix[:3, :3]) * np.eye(3) - matrix[:3, :3]
    return np.array([matrix[3, 3], *matrix[:3, 3], *(inertia[at] for at in _AT)])


def basis() -> Array:
    """Return the derivatives of the pseudo-inertia with respect to the ten numbers, shape (10, 4, 4)."""
    return np.array([pseudo_inertia(unit) for unit in np.eye(10)])


def move(moments: Array, rotation: Array, translation: Array) -> Array:
    """Return the ten numbers of a body in the frame in which its own frame has this placement."""
    placement = np.eye(4)
    placement[:3, :3], placement[:3, 3] = rotation, translation
    return from_pseudo_inertia(placement @ pseudo_inertia(moments) @ placement.T)
