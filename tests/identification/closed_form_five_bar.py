"""The five-bar in closed form, and the Cramer-Rao bound by differences. Nothing here imports ckc_pin."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENGTHS = {
    "joint.theta_2.xyz.x": 0.2794,
    "joint.tip_left_fixed.xyz.x": 0.3048,
    "joint.theta_4.xyz.x": 0.2794,
    "joint.tip_right_fixed.xyz.x": 0.3048,
    "joint.theta_3.xyz.x": 0.3048,
}
READINGS = ("theta_1", "theta_2", "theta_3", "theta_4", "tip.x", "tip.y")


def read(lengths: Array, motors: Array) -> Array:
    """Return all readings (poses, 6) at motor angles (poses, 2), on the branch with the tip below the elbows."""
    proximal_left, distal_left, proximal_right, distal_right, base = lengths
    a, c = motors.T
    left = proximal_left * np.array([np.cos(a), np.sin(a)])
    right = proximal_right * np.array([np.cos(c), np.sin(c)]) + np.array([[base], [0.0]])
    span = right - left
    distance = np.hypot(*span)
    along = (distal_left**2 - distal_right**2 + distance**2) / (2 * distance)
    across = np.sqrt(distal_left**2 - along**2)
    tip = left + (along * span + across * np.array([span[1], -span[0]])) / distance
    relative = [np.arctan2(*(tip - elbow)[::-1]) - angle for elbow, angle in ((left, a), (right, c))]
    wrapped = [np.mod(angle + np.pi, 2 * np.pi) - np.pi for angle in relative]
    return np.array([a, wrapped[0], c, wrapped[1], *tip]).T


def bound(predict: Callable[[Array], Array], unknowns: Array, sigma: Array, count: int) -> Array:
    """Return the Cramer-Rao bound of the first `count` unknowns' standard deviations, by central differences."""
    steps = 1e-6 * np.eye(len(unknowns))
    jacobian = np.array([(predict(unknowns + h) - predict(unknowns - h)).ravel() / 2e-6 for h in steps]).T
    jacobian /= np.broadcast_to(sigma, predict(unknowns).shape).reshape(-1, 1)
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))[:count])


def draw_motors(random: np.random.Generator, count: int) -> Array:
    """Return motor angles near the hanging position."""
    return np.array([-1.434, -1.707]) + random.uniform(-0.6, 0.6, (count, 2))


def columns(readings: Array, names: Sequence[str]) -> dict[str, Array]:
    """Return the readings of some names."""
    return {name: readings[:, READINGS.index(name)] for name in names}
