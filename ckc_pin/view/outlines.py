"""Projections of a mechanism's links on a plane, for figures and GIFs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view import style
from ckc_pin.view.geometry import COINCIDENCE_TOLERANCE, Placements, Projection
from ckc_pin.view.hulls import compute_hull_outline
from ckc_pin.view.links import SLIDER_LENGTH, Bar, LinkShapes

__all__ = ["BaseOutline", "Outline", "draw_base", "project_base", "project_outline"]

END_ON_SINE = 0.3  # a slider is drawn end-on if the sine of its angle to the line of sight is smaller
SLIDER_WIDTH = 0.022  # half the width of a slider, of the mechanism's size
CYLINDER_WIDTH = 0.016  # half the width of a cylinder
GROUND_COLOUR = "#E8E8E8"  # of a ground with three or more points


@dataclass(frozen=True)
class Outline:
    """The moving parts of a mechanism in one pose, projected on a plane.

    Attributes
    ----------
    bars : list of (2, 2) arrays
        Ends of bars and rods by axis of the plane, m.
    plates : list of (k, 2) arrays
        Corners of plates, in order, m.
    rings : (m, 2) array
        Hinges, m.
    blocks : list of (4, 2) arrays
        Corners of sliders and cylinders, m.
    """

    bars: list[Array]
    plates: list[Array]
    rings: Array
    blocks: list[Array]


@dataclass(frozen=True)
class BaseOutline:
    """The fixed parts of a mechanism, projected on a plane.

    Attributes
    ----------
    ground : (k, 2) array
        Corners of the ground, in order, m; two for a bar between two pins.
    rails : list of (2, 2) arrays
        Ends of the base's rails, m.
    """

    ground: Array
    rails: list[Array]


def project_outline(mechanism: Mechanism, shapes: LinkShapes, pose: Placements, plane: Projection) -> Outline:
    """Project the moving parts of a mechanism on a plane; `pose` holds one configuration."""

    def place(joint: int, points: Array) -> Array:
        return np.asarray(points @ pose.rotation[0, joint].T + pose.translation[0, joint])

    def place_bar(bar: Bar) -> Array:
        return place(bar.joint, np.array([bar.start, bar.end]))

    moving_rails = [bar for bar in shapes.rails if bar.joint]  # `project_base` returns those of the base.
    bars = [place_bar(bar) for bar in shapes.bars]
    corners = [place(plate.joint, plate.corners) for plate in shapes.plates]
    rods, cylinders = [place_bar(bar) for bar in shapes.rods], [place_bar(bar) for bar in shapes.cylinders]
    centres = [place(slider.joint, slider.centre) for slider in shapes.sliders]
    # Outer ends of a cylinder and its rod are hinges; the inner ends are not.
    ends = [*(end for bar in bars for end in bar), *(corner for plate in corners for corner in plate),
            *(rod[1] for rod in rods), *(cylinder[0] for cylinder in cylinders), *shapes.base_pins]  # fmt: skip
    tolerance = COINCIDENCE_TOLERANCE * mechanism.size
    rings = [end for end in ends if all(np.linalg.norm(end - centre) > tolerance for centre in centres)]
    blocks = [
        _project_slider(plane, centre, pose.rotation[0, slider.joint] @ slider.direction, mechanism.size)
        for slider, centre in zip(shapes.sliders, centres, strict=True)
    ]
    blocks += [_project_cylinder(plane, cylinder, mechanism.size) for cylinder in cylinders]
    return Outline(
        [ends @ plane.axes.T for ends in [*bars, *rods, *map(place_bar, moving_rails)]],
        [compute_hull_outline(plate @ plane.axes.T) for plate in corners],
        np.array(rings).reshape(-1, 3) @ plane.axes.T,
        blocks,
    )


def _project_slider(plane: Projection, centre: Array, direction: Array, size: float) -> Array:
    middle, projected = plane.axes @ centre, plane.axes @ direction
    is_end_on = np.linalg.norm(projected) <= END_ON_SINE
    long = SLIDER_LENGTH * size * (np.array([0.5, 0.0]) if is_end_on else projected)
    return _create_rectangle(middle, long, SLIDER_WIDTH * size)


def _project_cylinder(plane: Projection, ends: Array, size: float) -> Array:
    start, end = ends @ plane.axes.T
    long = 0.5 * (end - start)
    if np.linalg.norm(long) < CYLINDER_WIDTH * size:  # It is seen end-on.
        long = CYLINDER_WIDTH * size * np.array([1.0, 0.0])
    return _create_rectangle(0.5 * (start + end), long, CYLINDER_WIDTH * size)


def _create_rectangle(middle: Array, long: Array, half_width: float) -> Array:
    wide = half_width * np.array([-long[1], long[0]]) / np.linalg.norm(long)
    return np.array([middle + a * long + b * wide for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))])


def project_base(shapes: LinkShapes, plane: Projection) -> BaseOutline:
    """Project the fixed parts on a plane."""
    points = np.array(shapes.base_points).reshape(-1, 3) @ plane.axes.T
    rails = [np.array([bar.start, bar.end]) @ plane.axes.T for bar in shapes.rails if not bar.joint]
    return BaseOutline(compute_hull_outline(points) if len(points) else points, rails)


def draw_base(ax: Any, base: BaseOutline) -> None:
    """Draw the fixed parts on matplotlib's axes, behind all links."""
    if len(base.ground) > 2:
        ax.fill(*base.ground.T, color=GROUND_COLOUR, linewidth=0, zorder=0.5)
    elif len(base.ground) == 2:
        alpha = 0.5 if base.rails else 1.0
        ax.plot(*base.ground.T, color=style.GREY, linewidth=3.0, alpha=alpha, zorder=1)
    for rail in base.rails:
        ax.plot(*rail.T, color="black", linewidth=1.0, zorder=2, marker="|", markersize=5)
