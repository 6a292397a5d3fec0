"""Runs as commands for the viewer: objects (one group for each body, named by its joint) and one animation.

The browser then plays without us, with meshcat's time slider. Keyframes are output instants of the runs, not
interpolations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import bodies, commands
from ckc_pin.view.arrows import arrow_scales, arrow_tracks, arrows, draw_arrows, forces_path
from ckc_pin.view.camera import WORLD, extent_of_motions, surroundings
from ckc_pin.view.commands import Command, Track
from ckc_pin.view.desired import desired_poses
from ckc_pin.view.gaps import gaps
from ckc_pin.view.labels import run_labels
from ckc_pin.view.skeleton import Placements, configurations, placements
from ckc_pin.view.visuals import Colour

__all__ = ["body_tracks", "run_path", "scene"]

KEYFRAMES = 60  # a second of playback, as far as the run has them
FEWEST, MOST = 2000, 20_000  # of a run: the first so that it can be slowed down, the second for the browser's sake
TRACE: Colour = (0.25, 0.25, 0.28)


def scene(
    runs: Sequence[Run], *, speed: float = 1.0, gap: float = 0.0, meshes: Path | None = None, forces: bool = False
) -> list[Command]:
    """Return the commands that draw and animate runs, the first one solid and the others translucent.

    Parameters
    ----------
    runs : sequence of Run
    speed : float
        Seconds of the run in a second of playback.
    gap : float
        Above zero: how many times larger the gaps of the loops are drawn.
    meshes : Path, optional
        Folder of the URDFs' mesh files.
    forces : bool
        Draw the forces of loops and motors as arrows.

    Raises
    ------
    InputError
        A shape of a URDF that cannot be.
    """
    rows = [_keyframes(run.t, speed) for run in runs]
    poses = [configurations(run, at) for run, at in zip(runs, rows, strict=True)]
    motions = [placements(run.mechanism, q) for run, q in zip(runs, poses, strict=True)]
    drawing = surroundings(runs[0].mechanism, extent_of_motions(runs[0].mechanism, motions))
    tracks: list[Track] = []
    for k, (run, at, q, moved) in enumerate(zip(runs, rows, poses, motions, strict=True)):
        root, look, t = run_path(runs, k), bodies.ACROSS if k else bodies.SOLID, run.t[at]
        drawing += bodies.draw_bodies(run.mechanism, root, moved, look, meshes)
        drawing += bodies.draw_loop_frames(run.mechanism, root, look)
        drawing += [commands.polyline(f"{root}/trace:{bodies.safe(name)}", path, TRACE, look.opacity)
                    for name, path in run.points.items()]  # fmt: skip
        tracks += body_tracks(run.mechanism, root, t, moved)
        if gap > 0:
            drawing += bodies.draw_gaps(run.mechanism, root, look)
            tracks += _gap_tracks(run.mechanism, root, t, q, moved, gap)
    drawing, tracks = _with_ghost(runs, rows, drawing, tracks, meshes)
    drawing, tracks = _with_forces(runs, rows, motions, drawing, tracks) if forces else (drawing, tracks)
    names = [{"path": run_path(runs, k), "label": label, "t_end": float(run.t[-1]), "said": _ending(run)}
             for k, (run, label) in enumerate(zip(runs, run_labels(runs), strict=True))]  # fmt: skip
    arrows_of = [forces_path(run_path(runs, k)) for k in range(len(runs))] if forces else []
    return [*drawing, commands.name_runs(names, arrows_of), commands.set_animation(tracks, speed)]


def _ending(run: Run) -> str:
    if run.status == "done":
        return ""
    return run.message if run.message.startswith(run.status) else f"{run.status} at {run.t[-1]:.4g} s: {run.message}"


def _with_forces(
    runs: Sequence[Run], rows: Sequence[IntArray], motions: Sequence[Placements], drawing: list[Command],
    tracks: list[Track],
) -> tuple[list[Command], list[Track]]:  # fmt: skip
    """Add the arrows of all runs, at one scale, and say what it is."""
    found = [arrows(run, at, moved) for run, at, moved in zip(runs, rows, motions, strict=True)]
    scales = arrow_scales(found)
    for k, (run, at, own) in enumerate(zip(runs, rows, found, strict=True)):
        root, look = run_path(runs, k), bodies.ACROSS if k else bodies.SOLID
        drawing += draw_arrows(root, own, look.opacity)
        tracks += arrow_tracks(root, own, run.t[at], run.mechanism.size, scales)
    sizes = [f"{scales[turns]:.3g} {'N m' if turns else 'N'}" for turns in sorted(scales)]
    if sizes:
        drawing.append(commands.say(f"long arrows: {', '.join(sizes)}"))
    return drawing, tracks


def run_path(runs: Sequence[Run], k: int) -> str:
    """Return the path of a run's objects."""
    return f"{WORLD}/{k + 1}: {bodies.safe(run_labels(runs)[k])}"


def body_tracks(mechanism: Mechanism, root: str, t: Array, moved: Placements) -> Iterator[Track]:
    """Yield the ways of all bodies."""
    for joint in range(1, mechanism.tree.model.njoints):
        turned = _quaternions(moved.rotation[:, joint])
        ways = {"position": moved.translation[:, joint], "quaternion": turned}
        yield Track(bodies.body_path(mechanism, root, joint), t, ways)


def _with_ghost(
    runs: Sequence[Run], rows: Sequence[IntArray], drawing: list[Command], tracks: list[Track], meshes: Path | None
) -> tuple[list[Command], list[Track]]:
    """Add the pose that the first controlled run should have; it is hidden while the mechanism cannot have it."""
    for k, (run, at) in enumerate(zip(runs, rows, strict=True)):
        wanted = desired_poses(run, at)
        if wanted is None:
            continue
        root, t = f"{run_path(runs, k)}/desired", run.t[at]
        moved = placements(run.mechanism, wanted.q_tree)
        drawing += bodies.draw_bodies(run.mechanism, root, moved, bodies.GHOST, meshes)
        tracks += body_tracks(run.mechanism, root, t, moved)
        if not wanted.exists.all():
            tracks.append(Track(root, t, {"visible": wanted.exists}))
        break
    return drawing, tracks


def _gap_tracks(
    mechanism: Mechanism, root: str, t: Array, q_tree: Array, moved: Placements, gap: float
) -> Iterator[Track]:
    """Stretch each loop's rod from frame B over its gap, so many times larger."""
    ends = {loop.name: mechanism.frames.find(loop.frame_b, loop.name) for loop in mechanism.spec.loop}
    for loop, way in gaps(mechanism, q_tree).items():
        start, way = moved.of(ends[loop].joint, ends[loop].translation), gap * way
        path = bodies.gap_path(root, loop)
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)  # none at all has no direction
        stretched = np.column_stack([np.ones((len(t), 2)), length])
        turned = np.array([pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), w).coeffs() for w in way])
        yield Track(f"{path}/way", t, {"position": start, "quaternion": turned, "scale": stretched})
        yield Track(f"{path}/end", t, {"position": start + way})


def _keyframes(t: Array, speed: float) -> IntArray:
    """Output instants to show: all, or where there are very many those nearest to an even rate."""
    wanted = np.clip(math.ceil((t[-1] - t[0]) / speed * KEYFRAMES), FEWEST, MOST)
    if wanted >= len(t):
        return np.arange(len(t))
    instants = np.linspace(t[0], t[-1], int(wanted))
    after = np.clip(np.searchsorted(t, instants), 1, len(t) - 1)
    return np.unique(after - (instants - t[after - 1] < t[after] - instants))


def _quaternions(rotations: Array) -> Array:
    """Return unit quaternions x, y, z, w of rotations (m, 3, 3), without jumps of sign between instants."""
    quaternions = np.array([pin.Quaternion(rotation).coeffs() for rotation in rotations])
    jumps = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    return quaternions
