"""Drawing commands for a mechanism's bodies, loop frames and loop gaps; each body is a group named by its joint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view import commands
from ckc_pin.view.commands import Command
from ckc_pin.view.geometry import (
    COINCIDENCE_TOLERANCE,
    Placements,
    find_position_loops,
    homogeneous,
)
from ckc_pin.view.hulls import compute_flat_hull, compute_solid_hull
from ckc_pin.view.links import SLIDER_LENGTH, Bar, Plate, compute_rank, find_ground, find_link_shapes
from ckc_pin.view.visuals import Colour, Surface, Visual, load_surface, read_visuals

__all__ = ["GHOST", "SOLID", "TRANSLUCENT", "Appearance", "body_path", "draw_bodies", "draw_gaps", "draw_loop_frames",
           "escape_path", "find_missing_meshes", "gap_path", "place_bodies", "stretch_gaps"]  # fmt: skip

BASE_COLOUR: Colour = (0.45, 0.47, 0.50)
FRAME_A_COLOUR: Colour = (0.10, 0.10, 0.10)
FRAME_B_COLOUR: Colour = (0.94, 0.89, 0.26)
GROUND_COLOUR: Colour = (0.66, 0.68, 0.71)  # of a base without visuals
RAIL_COLOUR: Colour = (0.25, 0.25, 0.28)  # of the base's rails
GAP_COLOUR: Colour = (0.80, 0.15, 0.25)
LINK_COLOURS: tuple[Colour, ...] = (  # the palette of Okabe and Ito
    (0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
)  # fmt: skip
# Lengths relative to the mechanism's size.
ROD_RADIUS = 0.03
SLIDER_WIDTH = 0.06
GAP_ROD_RADIUS = 0.008
MIN_GAP_LENGTH = 1e-9  # m; a vector of length zero has no direction
FRAME_A_RADIUS, FRAME_B_RADIUS = 0.018, 0.03
THICKNESSES = 7  # of plates


@dataclass(frozen=True)
class Appearance:
    """Opacity of a mechanism, and one colour for all links if they do not keep their own. A ghost has no base."""

    opacity: float = 1.0
    colour: Colour | None = None
    is_ghost: bool = False

    def create_material(self, colour: Colour, on_top: bool = False) -> dict[str, Any]:
        """Return the material of an object of some colour."""
        return commands.create_material(self.colour or colour, self.opacity, on_top)


SOLID = Appearance()
TRANSLUCENT = Appearance(opacity=0.4)  # of all runs but the first
GHOST = Appearance(opacity=0.22, colour=(0.25, 0.27, 0.30), is_ghost=True)  # of the desired pose


def escape_path(name: str) -> str:
    """Escape a name for use as one element of a path."""
    return name.replace("%", "%25").replace("/", "%2F")


def body_path(mechanism: Mechanism, root: str, joint: int) -> str:
    """Return the path of a body."""
    return f"{root}/joint:{escape_path(mechanism.tree.model.names[joint])}" if joint else f"{root}/base"


# --- bodies --------------------------------------------------------------------------------------


def draw_bodies(
    mechanism: Mechanism, root: str, poses: Placements, appearance: Appearance, meshes: Path | None = None
) -> Iterator[Command]:
    """Draw the links by their URDF's visuals, and links without visuals as rods and plates. A ghost has no base.

    Parameters
    ----------
    poses : Placements
        All poses that will be shown: they give the lengths of rails, cylinders and their rods.
    meshes : Path, optional
        Folder of the mesh files, if it is not the mechanism's own.
    """
    folder = meshes or mechanism.sources.folder
    visuals = [visual for visual in read_visuals(mechanism) if visual.joint or not appearance.is_ghost]
    joints = range(mechanism.tree.model.njoints - 1)
    palette = [BASE_COLOUR, *(LINK_COLOURS[k % len(LINK_COLOURS)] for k in joints)]
    urdf_colours = {visual.joint: visual.colour for visual in reversed(visuals) if visual.joint}
    # The URDF's colours are used for links only if they tell all links apart.
    is_distinct = None not in urdf_colours.values() and len(set(urdf_colours.values())) == len(urdf_colours)
    drawn_joints = set()
    for k, visual in enumerate(visuals):
        colour = visual.colour if visual.colour and (is_distinct or not visual.joint) else palette[visual.joint]
        path = f"{body_path(mechanism, root, visual.joint)}/link:{escape_path(visual.link)}/{k}"
        command = _draw_visual(visual, path, appearance.create_material(colour), folder)
        if command is not None:
            drawn_joints.add(visual.joint)
            yield command
    yield from _draw_links(mechanism, root, poses, drawn_joints, palette, appearance)


def place_bodies(mechanism: Mechanism, root: str, poses: Placements) -> list[Command]:
    """Return the commands that move all bodies to the first of some poses."""
    return [
        commands.set_transform(
            body_path(mechanism, root, joint), homogeneous(poses.rotation[0, joint], poses.translation[0, joint])
        )
        for joint in range(1, mechanism.tree.model.njoints)
    ]


def find_missing_meshes(mechanism: Mechanism, meshes: Path | None = None) -> list[str]:
    """Return the mesh files that cannot be loaded; a link without other visuals is then drawn as rods."""
    folder = meshes or mechanism.sources.folder
    scales = {visual.file: visual.size for visual in read_visuals(mechanism) if visual.shape == "mesh"}
    return [file for file, scale in scales.items() if load_surface(file, scale, folder) is None]


def _draw_visual(visual: Visual, path: str, material: dict[str, Any], folder: Path | None) -> Command | None:
    if visual.shape != "mesh":
        return commands.draw_primitive(path, visual.shape, visual.size, visual.placement, material)
    surface = load_surface(visual.file, visual.size, folder)
    if surface is None:
        return None
    corners, faces = surface
    return commands.draw_surface(path, corners, faces, visual.placement, material)


def _draw_links(
    mechanism: Mechanism, root: str, poses: Placements, drawn: set[int], palette: list[Colour], appearance: Appearance
) -> Iterator[Command]:
    """Draw bodies without visuals: their links, and a ball at each hinge."""
    radius = ROD_RADIUS * mechanism.size
    shapes = find_link_shapes(mechanism, poses)

    def material(joint: int, base_colour: Colour = GROUND_COLOUR) -> dict[str, Any]:
        return appearance.create_material(palette[joint] if joint else base_colour)

    def draw_bars(name: str, bars: Sequence[Bar], ratio: float) -> Iterator[Command]:
        base_colour = RAIL_COLOUR if name == "rail" else GROUND_COLOUR
        for k, bar in enumerate(bars):
            if bar.joint not in drawn and not (appearance.is_ghost and not bar.joint):
                path = f"{body_path(mechanism, root, bar.joint)}/{name}:{k}"
                placement, size = _place_cylinder(bar.start, bar.end), [ratio * radius, bar.length]
                yield commands.draw_primitive(path, "cylinder", size, placement, material(bar.joint, base_colour))

    def draw_plates(plates: Sequence[Plate]) -> Iterator[Command]:
        for k, plate in enumerate(plates):
            if plate.joint not in drawn:
                path = f"{body_path(mechanism, root, plate.joint)}/plate:{k}"
                corners, faces = _compute_plate(plate, mechanism.size)
                yield commands.draw_surface(path, corners, faces, np.eye(4), material(plate.joint))

    telescopic = {bar.joint for bar in shapes.rods}
    sliding = {slider.joint for slider in shapes.sliders}
    for joint in range(1, mechanism.tree.model.njoints):
        if joint not in drawn | telescopic | sliding and not _is_hidden_ball(mechanism, joint, drawn):
            path = f"{body_path(mechanism, root, joint)}/ball"
            yield commands.draw_primitive(path, "sphere", [1.4 * radius], np.eye(4), material(joint))
    yield from draw_bars("rod", shapes.bars, 1.0)
    yield from draw_plates(shapes.plates)
    yield from draw_bars("cylinder", shapes.cylinders, 1.3)
    yield from draw_bars("piston", shapes.rods, 0.6)
    yield from draw_bars("rail", shapes.rails, 0.5)
    for slider in shapes.sliders:
        if slider.joint not in drawn:
            path = f"{body_path(mechanism, root, slider.joint)}/slider"
            size = mechanism.size * np.array([SLIDER_WIDTH, SLIDER_WIDTH, 2 * SLIDER_LENGTH])
            end = slider.centre + slider.direction
            placement = _place_cylinder(slider.centre - slider.direction, end)
            yield commands.draw_primitive(path, "box", size, placement, material(slider.joint))
    if 0 not in drawn and not appearance.is_ghost:
        ground, posts = find_ground(mechanism, shapes, poses, radius)
        yield from draw_bars("rod", [shape for shape in ground if isinstance(shape, Bar)], 1.0)
        yield from draw_plates([shape for shape in ground if isinstance(shape, Plate)])
        yield from draw_bars("post", posts, 0.6)


def _compute_plate(plate: Plate, size: float) -> Surface:
    rank, normal = compute_rank(plate.corners, size)
    radius = ROD_RADIUS * size
    if rank > 2:
        return compute_solid_hull(plate.corners, 0.5 * radius)
    # Faces of different plates in one plane would flicker, so each body has a thickness of its own.
    thickness = radius * (1.0 + 0.05 * (plate.joint % THICKNESSES))
    return compute_flat_hull(plate.corners, normal, radius, thickness)


def _is_hidden_ball(mechanism: Mechanism, joint: int, drawn: set[int]) -> bool:
    """Return whether a hinge's ball always coincides with another body's ball; the two would flicker."""
    model, tolerance = mechanism.tree.model, COINCIDENCE_TOLERANCE * mechanism.size
    parent, position = model.parents[joint], model.jointPlacements[joint].translation
    if not _is_hinge(mechanism, joint):
        return False
    if parent and parent not in drawn and np.linalg.norm(position) < tolerance:
        return True
    siblings = [k for k in range(1, joint) if model.parents[k] == parent and k not in drawn and _is_hinge(mechanism, k)]
    return any(np.linalg.norm(model.jointPlacements[k].translation - position) < tolerance for k in siblings)


def _is_hinge(mechanism: Mechanism, joint: int) -> bool:
    return bool(mechanism.tree.model.joints[joint].shortname().startswith("JointModelR"))


def _place_cylinder(start: Array, end: Array) -> Array:
    """Return the placement of a cylinder along z between two points."""
    direction = (end - start) / np.linalg.norm(end - start)
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).matrix()
    return homogeneous(rotation, 0.5 * (start + end))


# --- loops ---------------------------------------------------------------------------------------


def draw_loop_frames(mechanism: Mechanism, root: str, appearance: Appearance) -> Iterator[Command]:
    """Draw frame A (dark, small) and frame B (light, larger) of every loop, visible through all other objects."""
    # Equal render orders would flicker where the frames coincide, so A is always drawn on B.
    sides = (("B", "frame_b", FRAME_B_COLOUR, FRAME_B_RADIUS), ("A", "frame_a", FRAME_A_COLOUR, FRAME_A_RADIUS))
    for loop in mechanism.spec.loop:
        for render_order, (side, key, colour, radius) in enumerate(sides, 1):
            frame = mechanism.frames.find(getattr(loop, key), f"loop {loop.name!r}")
            placement = homogeneous(frame.rotation, frame.translation)
            path = f"{body_path(mechanism, root, frame.joint)}/loop:{escape_path(loop.name)}:{side}"
            material = appearance.create_material(colour, on_top=True)
            yield commands.draw_primitive(path, "sphere", [radius * mechanism.size], placement, material, render_order)


def gap_path(root: str, loop: str) -> str:
    """Return the path of a loop's magnified gap."""
    return f"{root}/gap:{escape_path(loop)}"


def draw_gaps(mechanism: Mechanism, root: str, appearance: Appearance) -> Iterator[Command]:
    """Draw a rod of one metre along z and a ball for each loop. An animation stretches the rod to the magnified gap."""
    radius = GAP_ROD_RADIUS * mechanism.size
    middle = np.eye(4)
    middle[2, 3] = 0.5
    material = appearance.create_material(GAP_COLOUR, on_top=True)
    for loop in find_position_loops(mechanism):
        path = gap_path(root, loop)
        yield commands.draw_primitive(f"{path}/way/rod", "cylinder", [radius, 1.0], middle, material)
        yield commands.draw_primitive(f"{path}/end/ball", "sphere", [2.5 * radius], np.eye(4), material)


def stretch_gaps(
    mechanism: Mechanism, root: str, poses: Placements, offsets: Mapping[str, Array]
) -> dict[str, dict[str, Array]]:
    """Return how each loop's rod and ball of `draw_gaps` are placed so that the rod reaches from frame B to an offset.

    Parameters
    ----------
    offsets : mapping of str to (m, 3) array
        By loop, in the world's axes, m.

    Returns
    -------
    dict of str to dict of str to array
        By path, "position" (m, 3), and for rods "quaternion" (m, 4) and "scale" (m, 3).
    """
    frames = {loop.name: mechanism.frames.find(loop.frame_b, loop.name) for loop in mechanism.spec.loop}
    z, placements = np.array([0.0, 0.0, 1.0]), {}
    for loop, vectors in offsets.items():
        start = poses.point_positions(frames[loop].joint, frames[loop].translation)
        lengths = np.maximum(np.linalg.norm(vectors, axis=1), MIN_GAP_LENGTH)
        scale = np.column_stack([np.ones((len(vectors), 2)), lengths])
        rotations = np.array([pin.Quaternion.FromTwoVectors(z, vector).coeffs() for vector in vectors])
        placements[f"{gap_path(root, loop)}/way"] = {"position": start, "quaternion": rotations, "scale": scale}
        placements[f"{gap_path(root, loop)}/end"] = {"position": start + vectors}
    return placements
