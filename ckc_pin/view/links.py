"""Shapes of links without visuals: bars, plates, cylinders with their rods, and sliders on rails.

The player draws them in space, and figures and GIFs draw their projections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view.geometry import (
    Placements,
    Slide,
    compute_view_axes,
    find_body_points,
    find_slides,
    is_planar,
    up_direction,
)

__all__ = ["SLIDER_LENGTH", "Bar", "LinkShapes", "Plate", "Slider", "compute_rank", "find_ground",
           "find_link_shapes", "join_points"]  # fmt: skip

FLATNESS_TOLERANCE = 1e-3  # of the mechanism's size: points closer to a line or plane are drawn on it
SLIDER_LENGTH = 0.045  # half the length of a slider, of the mechanism's size
RAIL_MARGIN = 0.08  # of the mechanism's size: a rail is longer than the travel on either side
# Lengths of a cylinder and its rod, relative to the least distance between their outer ends.
MIN_CYLINDER_RATIO, MAX_CYLINDER_RATIO = 0.6, 0.95
MIN_ROD_RATIO = 0.9
ROD_OVERLAP_RATIO = 0.1  # of the rod inside its cylinder
MAX_SLOPE_SINE = 0.1  # of the base's plane, if the ground is a plate in it
GROUND_DISTANCE = 2.6  # of a planar mechanism's ground behind its links, in radii of a bar
MIN_CYLINDER_LENGTH = 0.05  # of the mechanism's size; a shorter link with a slide is drawn as a rail


@dataclass(frozen=True)
class Bar:
    """A straight part of a body between two points, in the body's axes, m."""

    joint: int
    start: Array
    end: Array

    @property
    def length(self) -> float:
        """Distance between the ends, m."""
        return float(np.linalg.norm(self.end - self.start))


@dataclass(frozen=True)
class Plate:
    """The convex hull of three or more points (k, 3) of a body that are not on a line, in the body's axes, m."""

    joint: int
    corners: Array


@dataclass(frozen=True)
class Slider:
    """A block on a rail: its centre and the rail's direction, in the axes of the sliding body."""

    joint: int
    centre: Array
    direction: Array


@dataclass(frozen=True)
class LinkShapes:
    """Shapes of all links of a mechanism, each with the number of its body; body 0 is the base.

    Attributes
    ----------
    bars : list of Bar
        Moving links with two points.
    plates : list of Plate
        Moving links with three or more points.
    cylinders, rods : list of Bar
        The two links of a slide whose ends stay apart, as those of a hydraulic cylinder.
    rails : list of Bar
    sliders : list of Slider
        The two links of every other slide.
    base_pins : list of (3,) arrays
        Points of the base other than those of rails.
    """

    bars: list[Bar] = field(default_factory=list)
    plates: list[Plate] = field(default_factory=list)
    cylinders: list[Bar] = field(default_factory=list)
    rods: list[Bar] = field(default_factory=list)
    rails: list[Bar] = field(default_factory=list)
    sliders: list[Slider] = field(default_factory=list)
    base_pins: list[Array] = field(default_factory=list)

    @property
    def base_points(self) -> list[Array]:
        """Points that the ground connects: its pins and the ends of its rails."""
        return [*self.base_pins, *(end for rail in self.rails if not rail.joint for end in (rail.start, rail.end))]


def find_link_shapes(mechanism: Mechanism, poses: Placements) -> LinkShapes:
    """Return the shapes of all links.

    Parameters
    ----------
    poses : Placements
        All poses that will be shown: they give the travel of slides.
    """
    points = find_body_points(mechanism)
    shapes = LinkShapes(base_pins=points[0])
    for slide in find_slides(mechanism):
        _add_slide(shapes, slide, points, poses, mechanism.size)
    slide_links = shapes.cylinders + shapes.rods
    for joint in range(1, len(points)):
        for shape in join_points(joint, points[joint], mechanism.size):
            if isinstance(shape, Plate):
                shapes.plates.append(shape)
            elif not any(_contains(bar, shape, mechanism.size) for bar in slide_links):
                shapes.bars.append(shape)
    return shapes


def join_points(joint: int, points: Sequence[Array] | Array, size: float) -> list[Bar | Plate]:
    """Join points of a body: one bar if they are on a line, else one plate; nothing for a single point."""
    rank, direction = compute_rank(points, size)
    if rank == 0:
        return []
    if rank == 1:
        positions = np.array(points) @ direction
        ends = (points[int(np.argmin(positions))], points[int(np.argmax(positions))])
        return [Bar(joint, *sorted(ends, key=lambda end: float(np.linalg.norm(end))))]
    return [Plate(joint, np.array(points))]


def compute_rank(points: Sequence[Array] | Array, size: float) -> tuple[int, Array]:
    """Return 0 for one point, 1 for points on a line, 2 in a plane, 3 in space; and the line's or plane's direction.

    The direction is a unit vector along the line, or normal to the plane. For other ranks it has no meaning.
    """
    if len(points) < 2:
        return 0, np.array([0.0, 0.0, 1.0])
    _, _, axes = np.linalg.svd(np.array(points) - np.mean(points, axis=0), full_matrices=True)
    extents = np.ptp(np.array(points) @ axes.T, axis=0)
    rank = int(np.sum(extents > FLATNESS_TOLERANCE * size))
    return rank, axes[2] if rank == 2 else axes[0]


# --- slides --------------------------------------------------------------------------------------


def _add_slide(shapes: LinkShapes, slide: Slide, points: list[list[Array]], poses: Placements, size: float) -> None:
    """Add a cylinder with its rod if the outer ends of both links stay apart, else a rail with a slider."""
    rotation = poses.rotation[:, slide.parent]
    offsets = poses.translation[:, slide.joint] - poses.point_positions(slide.parent, slide.origin)
    travel = np.einsum("kji,kj->ki", rotation, offsets) @ slide.direction
    # A slide does not rotate, so its direction in the child's axes is constant.
    child_direction = poses.rotation[0, slide.joint].T @ rotation[0] @ slide.direction
    on_parent = _find_positions(points[slide.parent], slide.origin, slide.direction, size)
    on_child = _find_positions(points[slide.joint], np.zeros(3), child_direction, size)
    sign = 1.0 if np.mean(travel) + np.mean(on_child) >= np.mean(on_parent) else -1.0
    # From here on, positions increase from the cylinder's outer end to the rod's.
    on_parent, on_child, travel = sign * on_parent, sign * on_child, sign * travel
    parent_axis, child_axis = sign * slide.direction, sign * child_direction
    distance = travel + on_child.max() - on_parent.min()
    min_distance, max_distance = float(distance.min()), float(distance.max())
    if not slide.parent or min_distance < MIN_CYLINDER_LENGTH * size:
        margin = RAIL_MARGIN * size
        ends = (slide.origin + x * parent_axis for x in (travel.min() - margin, travel.max() + margin))
        shapes.rails.append(Bar(slide.parent, *ends))
        shapes.sliders.append(Slider(slide.joint, np.zeros(3), child_direction))
        return
    overlap = ROD_OVERLAP_RATIO * min_distance
    length = float(np.ptp(on_parent))
    if length <= FLATNESS_TOLERANCE * size:  # The file gives no length, so that of the stroke is taken.
        bounds = MIN_CYLINDER_RATIO * min_distance, MAX_CYLINDER_RATIO * min_distance
        length = float(np.clip(max_distance - min_distance + overlap, *bounds))
    start = slide.origin + on_parent.min() * parent_axis
    shapes.cylinders.append(Bar(slide.parent, start, start + length * parent_axis))
    rod_length = max(float(np.ptp(on_child)), max_distance - length + overlap, MIN_ROD_RATIO * min_distance)
    end = on_child.max() * child_axis
    shapes.rods.append(Bar(slide.joint, end - rod_length * child_axis, end))


def _find_positions(points: Sequence[Array], origin: Array, direction: Array, size: float) -> Array:
    """Return the positions along a line of those points that are on it; the origin is one of them."""
    offsets = np.array([np.zeros(3), *(point - origin for point in points)])
    positions = offsets @ direction
    distances = np.linalg.norm(offsets - np.outer(positions, direction), axis=1)
    return np.asarray(positions[distances <= FLATNESS_TOLERANCE * size])


def _contains(bar: Bar, part: Bar, size: float) -> bool:
    """Return whether a bar of the same body contains another one."""
    axis = (bar.end - bar.start) / bar.length
    for point in (part.start, part.end):
        position = (point - bar.start) @ axis
        distance = np.linalg.norm(point - bar.start - np.clip(position, 0.0, bar.length) * axis)
        if bar.joint != part.joint or distance > FLATNESS_TOLERANCE * size:
            return False
    return True


# --- ground --------------------------------------------------------------------------------------


def find_ground(
    mechanism: Mechanism, shapes: LinkShapes, poses: Placements, radius: float
) -> tuple[list[Bar | Plate], list[Bar]]:
    """Return the base's bar or plate, and the posts that connect it with pins and rails.

    The ground of a planar mechanism is behind all links, so that no link crosses it. In space it is a bar or a level
    plate through its points, else a floor below the mechanism.

    Parameters
    ----------
    radius : float
        Of a bar, m.
    """
    points = np.array(shapes.base_points).reshape(-1, 3)
    up, is_flat = up_direction(mechanism), is_planar(mechanism)
    rank, direction = compute_rank(points, mechanism.size)
    is_level = rank < 2 or (rank == 2 and np.linalg.norm(np.cross(direction, up)) < MAX_SLOPE_SINE)
    if is_level and not is_flat:
        return join_points(0, points, mechanism.size), []
    towards_viewer = compute_view_axes(mechanism)[2] if is_flat else up
    body_points = enumerate(find_body_points(mechanism))
    heights = [poses.point_positions(joint, x) @ towards_viewer for joint, each in body_points for x in each]
    level = min(map(np.min, heights)) - GROUND_DISTANCE * radius
    feet = points + np.outer(level - points @ towards_viewer, towards_viewer)
    return join_points(0, feet, mechanism.size), [Bar(0, *ends) for ends in zip(points, feet, strict=True)]
