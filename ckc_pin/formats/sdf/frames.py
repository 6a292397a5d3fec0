"""FrameGraph of SDFormat: links, joints, frames and models, each with a pose relative to another one.

Full names have the models in which a frame is nested, as in "arm::hand::palm". The frame of a model is its name with
"::__model__"; "world" is the root.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import list_names

__all__ = ["MODEL_FRAME", "WORLD", "FrameGraph"]

WORLD = "world"
MODEL_FRAME = "__model__"


@dataclass
class _Frame:
    """A frame by its pose relative to another frame. Names are full ones."""

    where: str  # its element in messages
    relative_to: str
    pose: pin.SE3
    attached_to: str = ""  # a frame of the same rigid body; empty for a link
    placed: str = ""  # for a model: its frame that `pose` places, if it is not the model's own


@dataclass
class FrameGraph:
    """All frames of a file, by full name."""

    frames: dict[str, _Frame] = field(default_factory=dict)
    _poses: dict[str, pin.SE3 | None] = field(default_factory=dict)  # None while it is computed

    def add(
        self, name: str, where: str, relative_to: str, pose: pin.SE3, attached_to: str = "", placed: str = ""
    ) -> None:
        """Add a frame. Its name must be new."""
        if name in self.frames or name == WORLD:
            raise InputError(f"{where}: two frames are called {name!r}")
        self.frames[name] = _Frame(where, relative_to, pose, attached_to, placed)

    def find(self, name: str, scope: str, where: str) -> str:
        """Return the full name of a frame that an element inside a model refers to. It must exist."""
        if name == WORLD:
            return WORLD
        full = join(scope, name)
        for candidate in (full, join(full, MODEL_FRAME)):
            if candidate in self.frames:
                return candidate
        inside = [key.removeprefix(f"{scope}::") for key in self.frames if not scope or key.startswith(f"{scope}::")]
        raise InputError(f"{where}: there is no frame {name!r}; there are {list_names(inside) or 'none'}")

    def pose(self, name: str) -> pin.SE3:
        """Return the pose of a frame in the world. Poses must not form a cycle."""
        if name == WORLD:
            return pin.SE3.Identity()
        if name not in self._poses:
            self._poses[name] = None
            frame = self.frames[name]
            pose = self.pose(frame.relative_to) * frame.pose
            self._poses[name] = pose * self._in_model(frame.placed, name).inverse() if frame.placed else pose
        pose = self._poses[name]
        if pose is None:
            raise InputError(f"{self.frames[name].where}: its pose is relative to itself; poses form a cycle")
        return pose

    def _in_model(self, name: str, model: str) -> pin.SE3:
        """Return the pose of a frame relative to the model that it places."""
        pose, visited = pin.SE3.Identity(), set()
        while name != model:
            frame = self.frames.get(name)
            if frame is None or name in visited:
                where = self.frames[model].where
                raise InputError(f"{where}: placement_frame {name!r} is not placed relative to its model")
            visited.add(name)
            inner = self._in_model(frame.placed, name).inverse() if frame.placed else pin.SE3.Identity()
            pose, name = frame.pose * inner * pose, frame.relative_to
        return pose

    def link_of(self, name: str, where: str) -> str:
        """Return the link to which a frame is attached, or "world"."""
        visited = set()
        while name != WORLD and self.frames[name].attached_to:
            if name in visited:
                raise InputError(f"{where}: frame {name!r} is attached to itself")
            visited.add(name)
            name = self.frames[name].attached_to
        return name


def join(scope: str, name: str) -> str:
    """Return a full name."""
    return f"{scope}::{name}" if scope else name
