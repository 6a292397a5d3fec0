"""Drawing commands for whole runs: camera, objects of each mechanism, and one animation.

The browser then plays the animation by itself. Its keyframes are output times of the runs, without interpolation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import bodies, commands
from ckc_pin.view.arrows import (
    compute_arrow_scales,
    compute_arrows,
    create_arrow_tracks,
    draw_arrows,
    forces_path,
    format_arrow_scales,
)
from ckc_pin.view.commands import Command, Track
from ckc_pin.view.geometry import (
    Placements,
    compute_loop_gaps,
    compute_placements,
    compute_view_axes,
    find_body_points,
    homogeneous,
    is_planar,
    pinocchio_configurations,
    up_direction,
)
from ckc_pin.view.run_group import compute_desired_poses
from ckc_pin.view.style import label_runs
from ckc_pin.view.visuals import Colour

__all__ = ["WORLD", "draw_runs_3d", "estimate_reach", "motion_extent", "set_camera"]

KEYFRAMES_PER_SECOND = 60  # of playback, if the run has that many output times
MIN_KEYFRAMES = 2000  # of a run, so that it can be played slowly
MAX_KEYFRAMES = 20_000  # of a run, for the browser's memory
TRACE_COLOUR: Colour = (0.25, 0.25, 0.28)

WORLD = "/world"
FIELD_OF_VIEW_DEG = 40.0
GRID_CELL = 0.5  # m, of the viewer's own grid, which has 40 x 40 cells
VIEW_TO_SCENE = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # right, up, towards the viewer -> x, y, z


def draw_runs_3d(
    runs: Sequence[Run], *, speed: float = 1.0, gap: float = 0.0, meshes: Path | None = None, forces: bool = False
) -> list[Command]:
    """Return the commands that draw and animate runs. The first run is opaque, the others are translucent.

    Parameters
    ----------
    runs : sequence of Run
    speed : float
        Simulated seconds per second of playback.
    gap : float
        Above zero: factor by which the gaps of the loops are magnified.
    meshes : Path, optional
        Folder of the URDFs' mesh files.
    forces : bool
        Draw the forces of loops and motors as arrows.

    Raises
    ------
    InputError
        A URDF has an invalid visual.
    """
    rows = [_select_keyframes(run.t, speed) for run in runs]
    configurations = [pinocchio_configurations(run, selected) for run, selected in zip(runs, rows, strict=True)]
    motions = [compute_placements(run.mechanism, q) for run, q in zip(runs, configurations, strict=True)]
    desired = _find_desired_pose(runs, rows)
    extent = motion_extent(runs[0].mechanism, [*motions, desired.poses] if desired else motions)
    drawing = set_camera(runs[0].mechanism, extent)
    tracks: list[Track] = []
    for k, (run, selected, q, poses) in enumerate(zip(runs, rows, configurations, motions, strict=True)):
        root, appearance, t = _run_path(runs, k), _run_appearance(k), run.t[selected]
        drawing += bodies.draw_bodies(run.mechanism, root, poses, appearance, meshes)
        drawing += bodies.draw_loop_frames(run.mechanism, root, appearance)
        drawing += [
            commands.draw_polyline(f"{root}/trace:{bodies.escape_path(name)}", path, TRACE_COLOUR, appearance.opacity)
            for name, path in run.points.items()
        ]
        tracks += _create_body_tracks(run.mechanism, root, t, poses)
        if gap > 0:
            drawing += bodies.draw_gaps(run.mechanism, root, appearance)
            tracks += _create_gap_tracks(run.mechanism, root, t, q, poses, gap)
    if desired:
        _add_desired_pose(runs, rows, desired, drawing, tracks, meshes)
    if forces:
        _add_forces(runs, rows, motions, drawing, tracks)
    entries = [{"path": _run_path(runs, k), "label": label, "t_end": float(run.t[-1]), "outcome": _format_outcome(run)}
               for k, (run, label) in enumerate(zip(runs, label_runs(runs), strict=True))]  # fmt: skip
    force_paths = [forces_path(_run_path(runs, k)) for k in range(len(runs))] if forces else []
    return [*drawing, commands.set_runs(entries, force_paths), commands.set_animation(tracks, speed)]


def _format_outcome(run: Run) -> str:
    if run.status == "done":
        return ""
    return run.message if run.message.startswith(run.status) else f"{run.status} at {run.t[-1]:.4g} s: {run.message}"


def _run_path(runs: Sequence[Run], k: int) -> str:
    return f"{WORLD}/{k + 1}: {bodies.escape_path(label_runs(runs)[k])}"


def _run_appearance(k: int) -> bodies.Appearance:
    return bodies.TRANSLUCENT if k else bodies.SOLID


def _add_forces(
    runs: Sequence[Run], rows: Sequence[IntArray], motions: Sequence[Placements], drawing: list[Command],
    tracks: list[Track],
) -> None:  # fmt: skip
    """Add the force arrows of all runs at one scale, and show the scale in the status line."""
    groups = [compute_arrows(run, selected, poses) for run, selected, poses in zip(runs, rows, motions, strict=True)]
    scales = compute_arrow_scales(groups)
    for k, (run, selected, arrows) in enumerate(zip(runs, rows, groups, strict=True)):
        root = _run_path(runs, k)
        drawing += draw_arrows(root, arrows, _run_appearance(k).opacity)
        tracks += create_arrow_tracks(root, arrows, run.t[selected], run.mechanism.size, scales)
    if scales:
        drawing.append(commands.set_status(f"long arrows: {format_arrow_scales(scales)}"))


@dataclass(frozen=True)
class _DesiredPose:
    """The desired poses of run k at its keyframes (m), and whether they are reachable, (m,) of bool."""

    k: int
    poses: Placements
    is_reachable: BoolArray


def _find_desired_pose(runs: Sequence[Run], rows: Sequence[IntArray]) -> _DesiredPose | None:
    """Return the desired poses of the first controlled run."""
    for k, (run, selected) in enumerate(zip(runs, rows, strict=True)):
        desired = compute_desired_poses(run, selected)
        if desired is not None:
            return _DesiredPose(k, compute_placements(run.mechanism, desired.q_tree), desired.is_reachable)
    return None


def _add_desired_pose(
    runs: Sequence[Run], rows: Sequence[IntArray], desired: _DesiredPose, drawing: list[Command], tracks: list[Track],
    meshes: Path | None,
) -> None:  # fmt: skip
    """Add the desired pose as a ghost, hidden while it is unreachable."""
    run, root = runs[desired.k], f"{_run_path(runs, desired.k)}/desired"
    t = run.t[rows[desired.k]]
    drawing += bodies.draw_bodies(run.mechanism, root, desired.poses, bodies.GHOST, meshes)
    tracks += _create_body_tracks(run.mechanism, root, t, desired.poses)
    if not desired.is_reachable.all():
        tracks.append(Track(root, t, {"visible": desired.is_reachable}))


# --- animation -----------------------------------------------------------------------------------


def _create_body_tracks(mechanism: Mechanism, root: str, t: Array, poses: Placements) -> Iterator[Track]:
    """Yield the keyframes of all bodies."""
    for joint in range(1, mechanism.tree.model.njoints):
        values = {"position": poses.translation[:, joint], "quaternion": _to_quaternions(poses.rotation[:, joint])}
        yield Track(bodies.body_path(mechanism, root, joint), t, values)


def _create_gap_tracks(
    mechanism: Mechanism, root: str, t: Array, q_tree: Array, poses: Placements, gap: float
) -> Iterator[Track]:
    """Yield the keyframes that stretch each loop's rod from frame B over its magnified gap."""
    offsets = {loop: gap * offsets for loop, offsets in compute_loop_gaps(mechanism, q_tree).items()}
    for path, values in bodies.stretch_gaps(mechanism, root, poses, offsets).items():
        yield Track(path, t, values)


def _select_keyframes(t: Array, speed: float) -> IntArray:
    """Return the rows to show: all of them, or those nearest to a constant rate if there are very many."""
    count = np.clip(math.ceil((t[-1] - t[0]) / speed * KEYFRAMES_PER_SECOND), MIN_KEYFRAMES, MAX_KEYFRAMES)
    if count >= len(t):
        return np.arange(len(t))
    times = np.linspace(t[0], t[-1], int(count))
    upper = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    return np.unique(upper - (times - t[upper - 1] < t[upper] - times))


def _to_quaternions(rotations: Array) -> Array:
    """Return unit quaternions x, y, z, w of rotations (m, 3, 3), whose signs do not jump between rows."""
    quaternions = np.array([pin.Quaternion(rotation).coeffs() for rotation in rotations])
    jumps = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    return quaternions


# --- camera --------------------------------------------------------------------------------------


def set_camera(mechanism: Mechanism, extent: tuple[Array, Array]) -> list[Command]:
    """Return the commands that place camera, grid and background so that a motion of some extent is in sight.

    The viewer's camera always looks at the origin of its scene with z up. Therefore `WORLD` is placed: the centre of
    the motion at the origin, up along z, the viewer's side along -y. The camera is level with a planar mechanism and
    above any other one. The cells of the grid have a round size.

    Parameters
    ----------
    extent : (3,) and (3,) arrays
        Lower and upper bounds to the right, up and towards the viewer, metres.
    """
    low, high = extent
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    radius = max(float(half[0]), float(half[1]), 0.5 * mechanism.size)
    distance = 1.25 * radius / math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG)) + float(half[2])
    if is_planar(mechanism):  # The grid is a wall behind the mechanism.
        cell = _round_down(0.3 * radius)
        grid = homogeneous(cell / GRID_CELL * VIEW_TO_SCENE, np.array([0.0, half[2] + 0.3 * mechanism.size, 0.0]))
    else:  # The grid is a floor, small enough that the camera does not stand on it.
        cell = _round_down(0.15 * radius)
        grid = homogeneous(cell / GRID_CELL * np.eye(3), np.array([0.0, 0.0, -half[1] - 0.1 * mechanism.size]))
    axes, height = _compute_camera_axes(mechanism)
    camera = "/Cameras/default/rotated/<object>"  # In this frame y points up and the camera looks along -z.
    return [
        commands.set_property("/Background", "top_color", [1.0, 1.0, 1.0]),
        commands.set_property("/Background", "bottom_color", [0.90, 0.92, 0.95]),
        commands.set_property("/Axes", "visible", False),
        commands.set_property("/Grid", "color", [1.0, 1.0, 1.0, 0.25]),
        commands.set_transform("/Grid", grid),
        commands.set_transform(WORLD, homogeneous(VIEW_TO_SCENE @ axes, -VIEW_TO_SCENE @ centre)),
        commands.set_property(camera, "fov", FIELD_OF_VIEW_DEG),
        commands.set_property(camera, "near", 0.01 * distance),
        commands.set_property(camera, "far", 100.0 * distance),
        commands.set_property(camera, "position", [0.0, height * distance, math.sqrt(1 - height**2) * distance]),
    ]


def motion_extent(mechanism: Mechanism, motions: Sequence[Placements]) -> tuple[Array, Array]:
    """Return the bounds of all points of bodies during motions, in the viewer's axes, m."""
    points = [
        poses.point_positions(joint, point)
        for poses in motions
        for joint, body_points in enumerate(find_body_points(mechanism))
        for point in body_points
    ]
    projected = np.concatenate(points) @ _compute_camera_axes(mechanism)[0].T if points else np.zeros((1, 3))
    return projected.min(axis=0), projected.max(axis=0)


def estimate_reach(mechanism: Mechanism, pose: Placements) -> tuple[Array, Array]:
    """Estimate the bounds of a future motion: the current pose, enlarged by the longest link on all sides, m."""
    low, high = motion_extent(mechanism, [pose])
    lengths = (np.linalg.norm(a - b) for points in find_body_points(mechanism) for a, b in combinations(points, 2))
    longest = max(map(float, lengths), default=mechanism.size)
    margin = longest * np.array([1.0, 1.0, 0.0 if is_planar(mechanism) else 1.0])
    return low - margin, high + margin


def _compute_camera_axes(mechanism: Mechanism) -> tuple[Array, float]:
    """Return right, up and towards the viewer as rows, (3, 3), and the sine of the camera's elevation."""
    view = compute_view_axes(mechanism)
    if is_planar(mechanism):
        return view, 0.0
    up = up_direction(mechanism)
    return np.array([view[0], up, np.cross(view[0], up)]), float(view[2] @ up)


def _round_down(length: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1, 2, 5) if step * power <= length)
