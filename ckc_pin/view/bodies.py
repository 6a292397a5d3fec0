"""Drawing commands for a mechanism's bodies, loop frames and loop gaps; each body is a group named by its joint."""

from __future__ import annotations

from collections.abc import Iterator
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
    Segment,
    find_position_loops,
    find_segments,
    homogeneous,
)
from ckc_pin.view.visuals import Colour, Visual, load_surface, read_visuals

__all__ = ["GHOST", "SOLID", "TRANSLUCENT", "Appearance", "body_path", "draw_bodies", "draw_gaps", "draw_loop_frames",
           "escape_path", "find_missing_meshes", "gap_path"]  # fmt: skip

BASE_COLOUR: Colour = (0.45, 0.47, 0.50)
FRAME_A_COLOUR: Colour = (0.10, 0.10, 0.10)
FRAME_B_COLOUR: Colour = (0.94, 0.89, 0.26)
GAP_COLOUR: Colour = (0.80, 0.15, 0.25)
LINK_COLOURS: tuple[Colour, ...] = (  # the palette of Okabe and Ito
    (0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
)  # fmt: skip
# Lengths relative to the mechanism's size.
ROD_RADIUS = 0.03
GAP_ROD_RADIUS = 0.008
FRAME_A_RADIUS, FRAME_B_RADIUS = 0.018, 0.03


@dataclass(frozen=True)
class Appearance:
    """Opacity of a mechanism, and one colour for all of its links if they do not keep their own."""

    opacity: float = 1.0
    colour: Colour | None = None

    def create_material(self, colour: Colour, on_top: bool = False) -> dict[str, Any]:
        """Return the material of an object of some colour."""
        return commands.create_material(self.colour or colour, self.opacity, on_top)


SOLID = Appearance()
TRANSLUCENT = Appearance(opacity=0.4)  # of all runs but the first
GHOST = Appearance(opacity=0.22, colour=(0.25, 0.27, 0.30))  # of the desired pose


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
    """Draw the links by their URDF's visuals, and links without visuals as rods. A ghost has no base.

    Parameters
    ----------
    poses : Placements
        All poses that will be shown: they give the lengths of rails.
    meshes : Path, optional
        Folder of the mesh files, if it is not the mechanism's own.
    """
    folder = meshes or mechanism.sources.folder
    visuals = [visual for visual in read_visuals(mechanism) if visual.joint or appearance is not GHOST]
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
    yield from _draw_rods(mechanism, root, poses, drawn_joints, palette, appearance)


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


def _draw_rods(
    mechanism: Mechanism, root: str, poses: Placements, drawn: set[int], palette: list[Colour], appearance: Appearance
) -> Iterator[Command]:
    """Draw bodies without visuals as rods with a ball at their joint, and the rails of slides as thinner rods."""
    radius = ROD_RADIUS * mechanism.size
    for joint in range(1, mechanism.tree.model.njoints):
        if joint not in drawn and not _is_hidden_ball(mechanism, joint, drawn):
            path = f"{body_path(mechanism, root, joint)}/ball"
            material = appearance.create_material(palette[joint])
            yield commands.draw_primitive(path, "sphere", [1.4 * radius], np.eye(4), material)
    for k, segment in enumerate(find_segments(mechanism)):
        if segment.joint in drawn or (appearance is GHOST and not segment.joint):
            continue
        is_rail = segment.joint != segment.end_joint
        start, end = _find_rail_ends(segment, poses) if is_rail else (segment.start, segment.end)
        length = float(np.linalg.norm(end - start))
        if length > COINCIDENCE_TOLERANCE * mechanism.size:
            path = f"{body_path(mechanism, root, segment.joint)}/{'rail' if is_rail else 'rod'}:{k}"
            size = [0.5 * radius if is_rail else radius, length]
            material = appearance.create_material(palette[segment.joint])
            yield commands.draw_primitive(path, "cylinder", size, _place_cylinder(start, end), material)


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


def _find_rail_ends(segment: Segment, poses: Placements) -> tuple[Array, Array]:
    """Return the ends of the line on which a slide moves, in the axes of the parent body."""
    offsets = poses.point_positions(segment.end_joint, segment.end) - poses.translation[:, segment.joint]
    points = np.vstack([segment.start, np.einsum("kji,kj->ki", poses.rotation[:, segment.joint], offsets)])
    farthest = points[np.argmax(np.linalg.norm(points - segment.start, axis=1))]
    positions = points @ (farthest - segment.start)
    return points[np.argmin(positions)], points[np.argmax(positions)]


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
