"""Rotor inertia, viscous damping, dry friction and stops of joints."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.spec import JointSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Joints"]


class Joints:
    """Dry friction and stops of a mechanism's joints, by coordinate.

    Values that the mechanism file does not give come from the URDF. The URDF's limits are stops only if the mechanism
    file says ``stops = true``.

    Parameters
    ----------
    tree : Tree
        Armature and damping are written to its model.
    specs : sequence of JointSpec

    Raises
    ------
    MechanismError
        An unknown joint, a joint given twice, stops without limits or with equal limits.

    Attributes
    ----------
    friction : (n,) array
        Largest force or torque of dry friction, N or N m.
    lower, upper : (n,) array
        Positions of the stops, rad or m, infinite if there is none.
    restitution : (n,) array
        Coefficient of restitution of impacts at the stops: speed after over speed before.
    stopped : (n,) bool array
        Whether a joint has stops.
    warnings : list of str
        Joint limits that are not stops.
    """

    def __init__(self, tree: Tree, specs: Sequence[JointSpec]) -> None:
        model, n = tree.model, tree.n
        self.friction = np.array(model.friction, dtype=float)
        self.lower, self.upper = np.full(n, -np.inf), np.full(n, np.inf)
        self.restitution = np.zeros(n)
        lower, upper = tree.limits()
        armature, damping = np.array(model.armature), np.array(model.damping)
        names = set[str]()
        for spec in specs:
            at = tree.joint_index(spec.name, "joint")
            if spec.name in names:
                raise MechanismError(f"joint: {spec.name!r} is given twice")
            names.add(spec.name)
            if spec.armature is not None:
                armature[at] = spec.armature
            if spec.damping is not None:
                damping[at] = spec.damping
            if spec.friction is not None:
                self.friction[at] = spec.friction
            if spec.stops:
                if not (np.isfinite(lower[at]) or np.isfinite(upper[at])):
                    raise MechanismError(f"joint {spec.name!r}: stops = true, but its URDF gives no limits")
                if not lower[at] < upper[at]:
                    raise MechanismError(f"joint {spec.name!r}: stops = true, but both its limits are {lower[at]:g}")
                self.lower[at], self.upper[at] = lower[at], upper[at]
                self.restitution[at] = spec.restitution
            elif spec.restitution:
                raise MechanismError(f"joint {spec.name!r}: a restitution goes with stops = true")
        model.armature, model.damping, model.friction = armature, damping, self.friction
        self.stopped = np.isfinite(self.lower) | np.isfinite(self.upper)
        self.warnings = _open_limits(tree, (np.isfinite(lower) | np.isfinite(upper)) & ~self.stopped)

    def without(self, immobile: BoolArray) -> Joints:
        """Return a copy without friction and stops of the joints that the mask, shape (n,), says cannot move."""
        joints = copy(self)
        joints.friction = np.where(immobile, 0.0, self.friction)
        joints.lower, joints.upper = np.where(immobile, -np.inf, self.lower), np.where(immobile, np.inf, self.upper)
        joints.stopped = self.stopped & ~immobile
        return joints

    def has_events(self, smoothing: float | None) -> bool:
        """Whether joints stick or reach stops. `smoothing` is the speed of smoothed friction, or None."""
        return bool(self.stopped.any()) or (smoothing is None and bool(self.friction.any()))

    def has_smooth_friction(self, smoothing: float | None) -> bool:
        """Whether there is smoothed friction, whose work a run does not count as `dissipated`."""
        return smoothing is not None and bool(self.friction.any())

    def smooth_friction(self, v_tree: Array, smoothing: float) -> Array:
        """Return the smoothed friction force -F tanh(v / smoothing), N or N m, shape (n,)."""
        return -self.friction * np.tanh(v_tree / smoothing)


def _open_limits(tree: Tree, limited: BoolArray) -> list[str]:
    """Warn of limits that a run may pass, and say how to make them stops."""
    names = [tree.coordinates[k] for k in np.flatnonzero(limited)]
    if not names:
        return []
    listed = ", ".join(names if len(names) <= 6 else [*names[:5], f"{len(names) - 5} more"])
    return [f"joint limits are not stops, so a run may pass them: {listed}; stops = true in their [[joint]] adds stops"]
