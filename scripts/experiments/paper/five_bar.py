"""Geometry of the paper's five-bar: link lengths, elbows and their distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose

__all__ = ["FIVE_BAR", "PRINTED", "Links", "elbow_distance", "links", "wrap"]

FIVE_BAR, PRINTED = "five_bar", "five_bar_as_printed"


@dataclass(frozen=True)
class Links:
    """Link lengths in chain numbering (1, 2 left, 3, 4 right, proximal first) and the base length, m."""

    l1: float
    l2: float
    l3: float
    l4: float
    base: float


def links(mechanism: Mechanism) -> Links:
    """Return the link lengths of a five-bar, measured on its tree at angles zero, where all links point along +x."""
    pose = Pose(mechanism.tree, mechanism.closure.anchors, np.zeros(4))
    left, elbow_left, right, elbow_right = (
        pose.translation[mechanism.tree.model.getJointId(f"theta_{k}")][0] for k in (1, 2, 3, 4)
    )
    tips = [
        (pose.rotation[frame.joint] @ frame.translation + pose.translation[frame.joint])[0]
        for frame in (mechanism.frames.find(name, "five-bar") for name in ("tip_left", "tip_right"))
    ]
    return Links(
        l1=float(elbow_left - left),
        l2=float(tips[0] - elbow_left),
        l3=float(elbow_right - right),
        l4=float(tips[1] - elbow_right),
        base=float(right - left),
    )


def elbow_distance(l: Links, theta_1: Array | float, theta_3: Array | float) -> Array:
    """Return the distance of the joints theta_2 and theta_4, m. The loop closes between |l2 - l4| and l2 + l4."""
    x = l.base + l.l3 * np.cos(theta_3) - l.l1 * np.cos(theta_1)
    y = l.l3 * np.sin(theta_3) - l.l1 * np.sin(theta_1)
    return np.asarray(np.hypot(x, y))


def wrap(angle: Array) -> Array:
    """Wrap angles to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
