"""Loops marked by pairs of frames, as onshape-to-robot leaves them where it cut a loop.

The frames are called closing_X_1 and closing_X_2, or NAME_1 and NAME_2. The file does not say which joint was cut.
Newer exports add closing_X_1_z and closing_X_2_z, which mark the axis of a hinge.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from ckc_pin.formats.robot import Robot
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["find_closing_frames"]

PREFIX = "closing_"
MAX_FRAME_MASS_KG = 1e-6  # onshape-to-robot exports a frame as a link of 1e-9 kg


def find_closing_frames(robot: Robot) -> None:
    """Add a loop for every pair of closing frames, without a type if the frames do not mark an axis."""
    for one, two in _pairs(robot):
        name = one.removesuffix("_1").removeprefix(PREFIX)
        if f"{one}_z" in robot.links and f"{two}_z" in robot.links:
            spec = LoopSpec(name=name, type="hinge", frame_a=one, frame_b=two)
            robot.loops.append((spec, f"the frames {one}_z and {two}_z mark its axis"))
        else:
            robot.untyped.append(LoopSpec(name=name, type="point", frame_a=one, frame_b=two))


def _pairs(robot: Robot) -> Iterator[tuple[str, str]]:
    """Yield NAME_1, NAME_2 where exactly these two exist; without the prefix, if both links are only frames."""
    numbers_by_stem: dict[str, list[str]] = {}
    for name in robot.links:
        match = re.fullmatch(r"(.+)_(\d+)", name)
        if match:
            numbers_by_stem.setdefault(match[1], []).append(match[2])
    frames = set(_frames(robot))
    for stem, numbers in numbers_by_stem.items():
        one, two = f"{stem}_1", f"{stem}_2"
        if sorted(numbers) == ["1", "2"] and (stem.startswith(PREFIX) or {one, two} <= frames):
            yield one, two


def _frames(robot: Robot) -> Iterator[str]:
    """Yield the links that are only frames: on a fixed joint, without mass, shapes or children."""
    parents = {joint.parent for joint in robot.joints.values()}
    for joint in robot.joints.values():
        link = robot.links[joint.child]
        is_bare = not link.visuals and link.body.mass <= MAX_FRAME_MASS_KG
        if joint.kind == "fixed" and joint.child not in parents and is_bare:
            yield joint.child
