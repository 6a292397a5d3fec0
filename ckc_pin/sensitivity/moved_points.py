"""How points that are reported move with parameters: with the coordinates, and with what places them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.native.variation import SensitivityParameter

__all__ = ["moved_points"]


def moved_points(
    mechanism: Mechanism, parameters: Sequence[SensitivityParameter], q_tree: Array, steps: Array
) -> dict[str, Array]:
    """Return how the mechanism's points move with each parameter, in world axes.

    Parameters
    ----------
    mechanism : Mechanism
    parameters : sequence of SensitivityParameter
    q_tree : (m, n) array
        By instant and coordinate, as a run has them.
    steps : (m, n, p) array
        How those change, of a free root as a twist in its own axes.

    Returns
    -------
    dict of str to (m, 3, p) arrays
        m for each parameter's unit.
    """
    found = {name: np.zeros((len(q_tree), 3, len(parameters))) for name in mechanism.points}
    if not found:
        return found
    placing = [(k, x) for k, x in enumerate(parameters) if x.places]
    for row, (numbers, step) in enumerate(zip(q_tree, steps, strict=True)):
        q = mechanism.tree.from_coordinates(numbers)
        for name, along in mechanism.point_jacobians(q).items():
            found[name][row] = along @ step
        if not placing:
            continue
        pose = Pose(mechanism.tree, mechanism.closure.anchors, q)
        for number, (name, at) in enumerate(mechanism.point_positions(q).items()):
            for k, x in placing:
                found[name][row, :, k] += _placed(mechanism, x, number, name, at, pose)
    return found


def _placed(mechanism: Mechanism, x: SensitivityParameter, number: int, name: str, at: Array, pose: Pose) -> Array:
    """How a point moves with what places it, and what places the joints that carry it."""
    carriers, total = set(mechanism.tree.model.supports[mechanism.points[name].joint]), np.zeros(3)
    for effect in x.places:
        assert effect.lock is not None
        placed, index = effect.lock.placed, effect.index
        if (placed == "joint" and index in carriers) or (placed == "reported" and index == number):
            axis = pose.rotation[effect.lock.carrier] @ effect.lock.axis
            arm = at - pose.translation[effect.lock.carrier]
            total += effect.numbers[0] * (np.cross(axis, arm) if effect.lock.turns else axis)
    return total
