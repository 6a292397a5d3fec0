"""What a joint itself does: rotor inertia, viscous damping, dry friction, stops."""

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
    """Dry friction and stops by coordinate; armature and damping go into the tree's model.

    What the URDF says holds where the mechanism's file says nothing; its limits are walls only where asked for.

    Parameters
    ----------
    tree : Tree
        Its model takes the armature and the damping.
    specs : sequence of JointSpec

    Raises
    ------
    MechanismError
        No such joint, a joint named twice, stops without limits or without room between them.

    Attributes
    ----------
    friction : (n,) array
        Largest force or torque of dry friction, N or N m.
    lower, upper : (n,) array
        Where the stops are, infinite where there is none.
    restitution : (n,) array
        Of an impact at a stop: speed after over speed before.
    warnings : list of str
        Limits that are no walls.
    """

    def __init__(self, tree: Tree, specs: Sequence[JointSpec]) -> None:
        model, n = tree.model, tree.n
        self.friction = np.array(model.friction, dtype=float)
        self.lower, self.upper = np.full(n, -np.inf), np.full(n, np.inf)
        self.restitution = np.zeros(n)
        lower, upper = tree.limits()
        armature, damping = np.array(model.armature), np.array(model.damping)
        seen = set[str]()
        for spec in specs:
            at = tree.joint_index(spec.name, "joint")
            if spec.name in seen:
                raise MechanismError(f"joint: {spec.name!r} is given twice")
            seen.add(spec.name)
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
        """Return the joints without friction and stops where a mask, shape (n,), says that loops hold them still."""
        joints = copy(self)
        joints.friction = np.where(immobile, 0.0, self.friction)
        joints.lower, joints.upper = np.where(immobile, -np.inf, self.lower), np.where(immobile, np.inf, self.upper)
        joints.stopped = self.stopped & ~immobile
        return joints

    def has_events(self, smoothing: float | None) -> bool:
        """Whether joints stick or touch, friction being smoothed or not (None)."""
        return bool(self.stopped.any()) or (smoothing is None and bool(self.friction.any()))

    def has_smooth_friction(self, smoothing: float | None) -> bool:
        """Whether friction is smoothed, so that its work is not part of a run's `dissipated`."""
        return smoothing is not None and bool(self.friction.any())

    def smooth_friction(self, v_tree: Array, smoothing: float) -> Array:
        """Return -F tanh(v / smoothing), N or N m, shape (n,)."""
        return -self.friction * np.tanh(v_tree / smoothing)


def _open_limits(tree: Tree, limited: BoolArray) -> list[str]:
    """Say which limits a run may pass, and how to make walls of them."""
    names = [tree.coordinates[k] for k in np.flatnonzero(limited)]
    if not names:
        return []
    some = ", ".join(names if len(names) <= 6 else [*names[:5], f"{len(names) - 5} more"])
    return [f"joint limits are no walls, a run may pass them: {some}; stops = true in their [[joint]] makes them walls"]
