"""How far a run's loops are open: what the magnified gaps of a playback show."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rows import Component, Distance

__all__ = ["gaps", "opening_loops"]


def gaps(mechanism: Mechanism, q_tree: Array) -> dict[str, Array]:
    """Return from B to A the part of p_A - p_B that a loop holds at zero, at configurations of the tree (m, nq).

    Returns
    -------
    dict of str to (m, 3) array
        In the world's axes, metres. What a loop lets go (the way along a slide, the length of a rod) is no gap, and
        a loop that holds directions alone has none.
    """
    at = opening_loops(mechanism)
    found = {loop: np.zeros((len(q_tree), 3)) for loop in at}
    for k, q in enumerate(q_tree):
        pose = Pose(mechanism.tree, mechanism.closure.anchors, q)
        for group in mechanism.closure.groups:
            if isinstance(group, Component):
                ways = pose.e[group.direction]
                offset = group.phi(pose)[:, None] * ways
            elif isinstance(group, Distance):
                r = pose.r[group.pair]
                lengths = np.linalg.norm(r, axis=1, keepdims=True)
                offset = r * (1.0 - group.length[:, None] / np.maximum(lengths, 1e-300))
            else:
                continue
            for row, way in zip(group.out, offset, strict=True):
                found[mechanism.closure.names[row][0]][k] += way
    return found


def opening_loops(mechanism: Mechanism) -> list[str]:
    """Return the loops that hold points together, in the order of the rows."""
    rows = [row for group in mechanism.closure.groups if isinstance(group, Component | Distance) for row in group.out]
    return list(dict.fromkeys(mechanism.closure.names[row][0] for row in sorted(rows)))
