"""Frames by name: a link, ``joint:NAME``, ``world``, or a table that places a frame in one of these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.spec import FrameSpec

__all__ = ["Frame", "Frames"]


@dataclass(frozen=True)
class Frame(Immutable):
    """A frame fixed in a joint of the tree (joint 0: the world): rotation (3, 3), translation (3,)."""

    joint: int
    rotation: Array
    translation: Array


class Frames:
    """The named frames of a Pinocchio model.

    `getFrameId` of an unknown name returns `nframes` without an error, and raises when a link and a
    joint share a name; here links and joints are two dictionaries.

    Attributes
    ----------
    links, joints : dict of str to Frame
    bodies : list of str
        By joint, the world first: the link that it carries, or the joint where fixed joints made several one.
    """

    def __init__(self, model: Any) -> None:
        self.links: dict[str, Frame] = {}
        self.joints: dict[str, Frame] = {}
        for frame in model.frames:
            placed = Frame(frame.parentJoint, frame.placement.rotation.copy(), frame.placement.translation.copy())
            if frame.type == pin.FrameType.BODY:
                self.links[frame.name] = placed
            elif frame.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT):
                self.joints[frame.name] = placed
        self.bodies = list(model.names)
        for link, placed in reversed(self.links.items()):
            if np.allclose(placed.rotation, np.eye(3)) and not placed.translation.any():
                self.bodies[placed.joint] = link

    def __deepcopy__(self, memo: dict[int, Any]) -> Frames:
        """Copy the tables; a frame stays what it is."""
        twin = Frames.__new__(Frames)
        twin.links, twin.joints, twin.bodies = dict(self.links), dict(self.joints), list(self.bodies)
        return twin

    def find(self, frame: str | FrameSpec, where: str) -> Frame:
        """Look a frame up.

        Raises
        ------
        MechanismError
            No such link or joint; the message lists those there are.
        """
        if isinstance(frame, str):
            return self._named(frame, where)
        base = self._named(frame.link, where)
        rotation = base.rotation @ pin.rpy.rpyToMatrix(*frame.rpy)
        return Frame(base.joint, rotation, base.translation + base.rotation @ np.array(frame.xyz))

    def _named(self, name: str, where: str) -> Frame:
        if name == "world":
            return Frame(0, np.eye(3), np.zeros(3))
        if name.startswith("joint:"):
            known, key, what = self.joints, name.removeprefix("joint:"), "joint"
        else:
            known, key, what = self.links, name, "link"
        if key not in known:
            choices = ", ".join(sorted(known))
            raise MechanismError(f"{where}: no {what} {key!r}; there are {choices}")
        return known[key]
