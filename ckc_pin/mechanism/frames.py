"""Named frames of a tree: a link, ``joint:NAME``, ``world``, or a frame placed relative to one of these."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.spec import FrameSpec

__all__ = ["Frame", "Frames"]


class Frame(Immutable, frozen=True):
    """A frame fixed to a joint of the tree (joint 0 is the world): rotation (3, 3), translation (3,)."""

    joint: int
    rotation: Array
    translation: Array


class Frames:
    """The named frames of a Pinocchio model.

    Links and joints are separate tables, since a link and a joint may share a name. (Pinocchio's `getFrameId` raises
    an error then, and returns `nframes` for an unknown name.)

    Attributes
    ----------
    links, joints : dict of str to Frame
    bodies : list of str
        Name of the body of each joint, the world first: its link, or the joint if fixed joints merged several links.
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
            if not placed.translation.any() and np.allclose(placed.rotation, np.eye(3)):
                self.bodies[placed.joint] = link

    def __deepcopy__(self, memo: dict[int, Any]) -> Frames:
        """Copy the tables. The frames are immutable and shared."""
        twin = Frames.__new__(Frames)
        twin.links, twin.joints, twin.bodies = dict(self.links), dict(self.joints), list(self.bodies)
        return twin

    def find(self, frame: str | FrameSpec, where: str) -> Frame:
        """Return the frame that a mechanism file describes.

        Raises
        ------
        MechanismError
            The link or joint does not exist; the message lists the valid names.
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
            table, key, what = self.joints, name.removeprefix("joint:"), "joint"
        else:
            table, key, what = self.links, name, "link"
        if key not in table:
            choices = ", ".join(sorted(table))
            raise MechanismError(f"{where}: no {what} {key!r}; there are {choices}")
        return table[key]
