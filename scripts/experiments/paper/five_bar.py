"""What only the paper's five-bar has: elbows, and what the paper says in terms of them."""

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
    """Lengths in chain numbering (1, 2 left, 3, 4 right, proximal first) and the base link, metres."""

    l1: float
    l2: float
    l3: float
    l4: float
    base: float


def links(mechanism: Mechanism) -> Links:
    """Measure the links of a five-bar on its tree at angles zero, where all of them point along +x."""
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
    """Distance between the joints theta_2 and theta_4, metres; the loop closes from |l2 - l4| to l2 + l4."""
    x = l.base + l.l3 * np.cos(theta_3) - l.l1 * np.cos(theta_1)
    y = l.l3 * np.sin(theta_3) - l.l1 * np.sin(theta_1)
    return np.asarray(np.hypot(x, y))


def wrap(angle: Array) -> Array:
    """Angles within [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
