"""Where the viewer stands: before a planar mechanism, above any other, with all of its motion in sight."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view import commands
from ckc_pin.view.commands import Command
from ckc_pin.view.skeleton import Placements, is_planar, sticks, upward, viewpoint

__all__ = ["WORLD", "extent_of_motions", "extent_of_reach", "surroundings"]

WORLD = "/world"
FIELD_OF_VIEW = 40.0  # degrees
SQUARE = 0.5  # m, of the viewer's own grid, which has 40 x 40 of them
RIGHT_UP_TOWARDS = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # to the scene's x, y, z


def surroundings(mechanism: Mechanism, extent: tuple[Array, Array]) -> list[Command]:
    """Face the mechanism, before or above a grid whose squares have a round size.

    The viewer always looks at the origin of its scene with z up, so the scene moves: `WORLD` is placed with the
    middle of the motion at the origin, up along z and the viewer's side along -y. The camera is level with a planar
    mechanism, and above any other.

    Parameters
    ----------
    extent : (3,) and (3,) arrays
        Bounds to the right, up and towards the viewer, metres.
    """
    low, high = extent
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = max(float(half[0]), float(half[1]), 0.5 * mechanism.size)
    distance = 1.25 * reach / math.tan(math.radians(0.5 * FIELD_OF_VIEW)) + float(half[2])
    if is_planar(mechanism):  # a wall behind it
        square = _round(0.3 * reach)
        grid = _frame(square / SQUARE * RIGHT_UP_TOWARDS, np.array([0.0, half[2] + 0.3 * mechanism.size, 0.0]))
    else:  # a floor, not so large that the camera stands on it
        square = _round(0.15 * reach)
        grid = _frame(square / SQUARE * np.eye(3), np.array([0.0, 0.0, -half[1] - 0.1 * mechanism.size]))
    axes, height = _axes(mechanism)
    camera = "/Cameras/default/rotated/<object>"  # in this frame y is up and the viewer looks along -z
    return [
        commands.set_property("/Background", "top_color", [1.0, 1.0, 1.0]),
        commands.set_property("/Background", "bottom_color", [0.90, 0.92, 0.95]),
        commands.set_property("/Axes", "visible", False),
        commands.set_property("/Grid", "color", [1.0, 1.0, 1.0, 0.25]),
        commands.set_transform("/Grid", grid),
        commands.set_transform(WORLD, _frame(RIGHT_UP_TOWARDS @ axes, -RIGHT_UP_TOWARDS @ centre)),
        commands.set_property(camera, "fov", FIELD_OF_VIEW),
        commands.set_property(camera, "near", 0.01 * distance),
        commands.set_property(camera, "far", 100.0 * distance),
        commands.set_property(camera, "position", [0.0, height * distance, math.sqrt(1 - height**2) * distance]),
    ]


def extent_of_motions(mechanism: Mechanism, motions: Sequence[Placements]) -> tuple[Array, Array]:
    """Bounds of every stick along the whole of the motions, in the viewer's axes."""
    ends = [
        moved.of(joint, point)
        for moved in motions
        for stick in sticks(mechanism)
        for joint, point in ((stick.joint, stick.start), (stick.end_joint, stick.end))
    ]
    seen = np.concatenate(ends) @ _axes(mechanism)[0].T if ends else np.zeros((1, 3))
    return seen.min(axis=0), seen.max(axis=0)


def extent_of_reach(mechanism: Mechanism, now: Placements) -> tuple[Array, Array]:
    """Bounds of a motion that is not known yet: where it is now, and the longest link's length around that."""
    low, high = extent_of_motions(mechanism, [now])
    longest = max((float(np.linalg.norm(s.end - s.start)) for s in sticks(mechanism) if s.joint == s.end_joint),
                  default=mechanism.size)  # fmt: skip
    room = longest * np.array([1.0, 1.0, 0.0 if is_planar(mechanism) else 1.0])
    return low - room, high + room


def _axes(mechanism: Mechanism) -> tuple[Array, float]:
    """Right, up and towards the viewer as rows, (3, 3), and the sine of the camera's height above level."""
    view = viewpoint(mechanism)
    if is_planar(mechanism):
        return view, 0.0
    up = upward(mechanism)
    return np.array([view[0], up, np.cross(view[0], up)]), float(view[2] @ up)


def _round(length: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1, 2, 5) if step * power <= length)


def _frame(axes: Array, origin: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, origin
    return matrix
