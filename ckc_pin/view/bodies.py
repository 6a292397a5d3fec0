"""A mechanism as objects in the viewer's tree: one group for each body, named by its joint."""

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
from ckc_pin.view.gaps import opening_loops
from ckc_pin.view.meshes import load_surface
from ckc_pin.view.skeleton import Placements, Stick, sticks
from ckc_pin.view.visuals import Colour, Visual, visuals

__all__ = ["ACROSS", "GHOST", "SOLID", "Look", "body_path", "draw_bodies", "draw_gaps", "draw_loop_frames", "gap_path",
           "missing_meshes", "safe"]  # fmt: skip

BASE: Colour = (0.45, 0.47, 0.50)
FRAME_A: Colour = (0.10, 0.10, 0.10)
FRAME_B: Colour = (0.94, 0.89, 0.26)
GAP: Colour = (0.80, 0.15, 0.25)
LINKS: tuple[Colour, ...] = (  # Okabe and Ito
    (0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
)  # fmt: skip


@dataclass(frozen=True)
class Look:
    """How opaque everything is, and in which one colour, where not each link has its own."""

    opacity: float = 1.0
    colour: Colour | None = None

    def of(self, colour: Colour, on_top: bool = False) -> dict[str, Any]:
        """Return the material of something that has a colour."""
        return commands.material(self.colour or colour, self.opacity, on_top)


SOLID = Look()
ACROSS = Look(opacity=0.4)  # of every run but the first
GHOST = Look(opacity=0.22, colour=(0.25, 0.27, 0.30))  # where it should be


def safe(name: str) -> str:
    """Return a name as one step of a path."""
    return name.replace("%", "%25").replace("/", "%2F")


def body_path(mechanism: Mechanism, root: str, joint: int) -> str:
    """Return the path of a body."""
    return f"{root}/joint:{safe(mechanism.tree.model.names[joint])}" if joint else f"{root}/base"


def draw_bodies(
    mechanism: Mechanism, root: str, moved: Placements, look: Look, meshes: Path | None = None
) -> Iterator[Command]:
    """Draw the links as their URDF shows them, and those of which it shows nothing as sticks; a ghost has no base.

    Parameters
    ----------
    moved : Placements
        How far slides go, whose rails are drawn.
    meshes : Path, optional
        Folder of the mesh files, where it is not the mechanism's own.
    """
    folder = meshes or mechanism.sources.folder
    shapes = [shape for shape in visuals(mechanism) if shape.joint or look is not GHOST]
    colours = [BASE, *(LINKS[k % len(LINKS)] for k in range(mechanism.tree.model.njoints - 1))]
    own = {shape.joint: shape.colour for shape in reversed(shapes) if shape.joint}
    distinct = None not in own.values() and len(set(own.values())) == len(own)  # by the URDF's own colours
    drawn = set()
    for k, shape in enumerate(shapes):
        colour = shape.colour if shape.colour and (distinct or not shape.joint) else colours[shape.joint]
        path = f"{body_path(mechanism, root, shape.joint)}/link:{safe(shape.link)}/{k}"
        command = _shape(shape, path, look.of(colour), folder)
        if command is not None:
            drawn.add(shape.joint)
            yield command
    yield from _sticks(mechanism, root, moved, drawn, colours, look)


def missing_meshes(mechanism: Mechanism, meshes: Path | None = None) -> list[str]:
    """Return the mesh files that cannot be had; where a link has nothing else it is drawn as sticks."""
    folder = meshes or mechanism.sources.folder
    shapes = {shape.file: shape.size for shape in visuals(mechanism) if shape.shape == "mesh"}
    return [file for file, scale in shapes.items() if load_surface(file, scale, folder) is None]


def _shape(shape: Visual, path: str, look: dict[str, Any], folder: Path | None) -> Command | None:
    if shape.shape != "mesh":
        return commands.body(path, shape.shape, shape.size, shape.placement, look)
    surface = load_surface(shape.file, shape.size, folder)
    if surface is None:
        return None
    corners, faces = surface
    return commands.surface(path, corners, faces, shape.placement, look)


def _sticks(
    mechanism: Mechanism, root: str, moved: Placements, drawn: set[int], colours: list[Colour], look: Look
) -> Iterator[Command]:
    """Draw bodies that have no shapes of their own as rods with a ball at their joint, and rails of slides thinner."""
    thick = 0.03 * mechanism.size
    for joint in range(1, mechanism.tree.model.njoints):
        if joint not in drawn:
            if _hidden_ball(mechanism, joint, drawn):
                continue
            ball = f"{body_path(mechanism, root, joint)}/ball"
            yield commands.body(ball, "sphere", [1.4 * thick], np.eye(4), look.of(colours[joint]))
    for k, stick in enumerate(sticks(mechanism)):
        if stick.joint in drawn or (look is GHOST and not stick.joint):
            continue
        rail = stick.joint != stick.end_joint
        start, end = _rail(stick, moved) if rail else (stick.start, stick.end)
        length = float(np.linalg.norm(end - start))
        if length > 1e-9 * mechanism.size:
            path = f"{body_path(mechanism, root, stick.joint)}/{'rail' if rail else 'rod'}:{k}"
            size = [0.5 * thick if rail else thick, length]
            yield commands.body(path, "cylinder", size, _along(start, end), look.of(colours[stick.joint]))


def _hidden_ball(mechanism: Mechanism, joint: int, drawn: set[int]) -> bool:
    """Whether a hinge's ball is always where that of the body it is on is, or of another hinge: they would flicker."""
    model, least = mechanism.tree.model, 1e-9 * mechanism.size
    parent, at = model.parents[joint], model.jointPlacements[joint].translation
    if not _is_hinge(mechanism, joint):
        return False
    if parent and parent not in drawn and np.linalg.norm(at) < least:
        return True
    beside = [k for k in range(1, joint) if model.parents[k] == parent and k not in drawn and _is_hinge(mechanism, k)]
    return any(np.linalg.norm(model.jointPlacements[k].translation - at) < least for k in beside)


def _is_hinge(mechanism: Mechanism, joint: int) -> bool:
    return bool(mechanism.tree.model.joints[joint].shortname().startswith("JointModelR"))


def _rail(stick: Stick, moved: Placements) -> tuple[Array, Array]:
    """Ends of the line on which a slide moves, in the axes of the body that carries it."""
    ways = moved.of(stick.end_joint, stick.end) - moved.translation[:, stick.joint]
    points = np.vstack([stick.start, np.einsum("kji,kj->ki", moved.rotation[:, stick.joint], ways)])
    along = points @ (points[np.argmax(np.linalg.norm(points - stick.start, axis=1))] - stick.start)
    return points[np.argmin(along)], points[np.argmax(along)]


def _along(start: Array, end: Array) -> Array:
    """Placement of a cylinder along z between two points."""
    placement = np.eye(4)
    direction = (end - start) / np.linalg.norm(end - start)
    placement[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).matrix()
    placement[:3, 3] = 0.5 * (start + end)
    return placement


# --- loops ---------------------------------------------------------------------------------------


def draw_loop_frames(mechanism: Mechanism, root: str, look: Look) -> Iterator[Command]:
    """Draw frames A (dark, small) and B (light, larger) of every loop, seen through everything else."""
    sides = (("B", "frame_b", FRAME_B, 0.03), ("A", "frame_a", FRAME_A, 0.018))  # A on B, or they would flicker
    for loop in mechanism.spec.loop:
        for order, (side, end, colour, radius) in enumerate(sides, 1):
            frame = getattr(loop, end)
            at = mechanism.frames.find(frame, f"loop {loop.name!r}")
            placement = np.eye(4)
            placement[:3, :3], placement[:3, 3] = at.rotation, at.translation
            path = f"{body_path(mechanism, root, at.joint)}/loop:{safe(loop.name)}:{side}"
            yield commands.body(
                path, "sphere", [radius * mechanism.size], placement, look.of(colour, on_top=True), order
            )


def gap_path(root: str, loop: str) -> str:
    """Return the path of a loop's magnified gap."""
    return f"{root}/gap:{safe(loop)}"


def draw_gaps(mechanism: Mechanism, root: str, look: Look) -> Iterator[Command]:
    """Draw for each loop a rod one metre long along z, to be stretched over its magnified gap, and its end."""
    thick = 0.008 * mechanism.size
    middle = np.eye(4)
    middle[2, 3] = 0.5
    for loop in opening_loops(mechanism):
        path = gap_path(root, loop)
        yield commands.body(f"{path}/way/rod", "cylinder", [thick, 1.0], middle, look.of(GAP, on_top=True))
        yield commands.body(f"{path}/end/ball", "sphere", [2.5 * thick], np.eye(4), look.of(GAP, on_top=True))
