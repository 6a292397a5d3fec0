"""Playback of saved runs in meshcat's viewer.

A run becomes objects (one group for each body, named by its joint) and one animation; the browser then plays
without us, with meshcat's time slider. Keyframes are output instants of the run, not interpolations.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from threading import Event
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array, IntArray
from ckc_pin.simulation.run import Run
from ckc_pin.view import commands
from ckc_pin.view.commands import Command
from ckc_pin.view.labels import run_labels
from ckc_pin.view.skeleton import Motion, Stick, is_planar, motion, sticks, upward, viewpoint
from ckc_pin.view.visuals import Colour, visuals

if TYPE_CHECKING:
    from ckc_pin.view.server import ViewServer

__all__ = ["play", "scene"]

WORLD = "/world"
KEYFRAMES = 60  # a second of playback, at most
OPACITY = 0.4  # of every run but the first
FIELD_OF_VIEW = 40.0  # degrees
BASE: Colour = (0.45, 0.47, 0.50)
FRAME_A: Colour = (0.10, 0.10, 0.10)
FRAME_B: Colour = (0.94, 0.89, 0.26)
TRACE: Colour = (0.25, 0.25, 0.28)
LINKS: tuple[Colour, ...] = (  # Okabe and Ito
    (0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
)  # fmt: skip


def play(
    runs: Run | Sequence[Run],
    *,
    speed: float = 1.0,
    open_browser: bool = False,
    port: int = 0,
    block: bool = True,
) -> ViewServer | None:
    """Play runs back in the browser, on this machine only; the first is solid, the others translucent.

    Parameters
    ----------
    runs : Run or sequence of Run
    speed : float
        Seconds of the run in a second of playback. The time slider shows the playback's.
    open_browser : bool
        Also open the address.
    port : int
        On 127.0.0.1; 0: any free one.
    block : bool
        Print the address and wait until Ctrl-C. Otherwise return the server, which plays until its `stop`.

    Returns
    -------
    ViewServer or None

    Raises
    ------
    InputError
        No run, a speed that is not above zero, a port in use, meshcat missing, a drawing that cannot be.
    """
    runs = [runs] if isinstance(runs, Run) else list(runs)
    if not runs:
        raise InputError("play: no run given; give at least one")
    if not (math.isfinite(speed) and speed > 0):
        raise InputError(f"play: speed = {speed}; it must be above zero, 1 is real time")
    drawing = scene(runs, speed)
    try:
        from ckc_pin.view.server import ViewServer
    except ModuleNotFoundError:
        raise InputError("playback needs meshcat and its tornado: pip install 'ckc_pin[view]'") from None
    from ckc_pin.view.page import page

    server = ViewServer(page(*_caption(runs, speed)), port)
    for command in drawing:
        server.send(command)
    if open_browser:
        import webbrowser

        if not webbrowser.open(server.url):
            print(f"no browser could be opened; open {server.url} in yours", file=sys.stderr)
    if not block:
        return server
    with server:
        try:
            print(f"{server.url}  (Ctrl-C ends)", flush=True)
            Event().wait()
        except KeyboardInterrupt:
            print()
    return None


def scene(runs: Sequence[Run], speed: float = 1.0) -> list[Command]:
    """Return the commands that draw and animate runs."""
    rows = [_keyframes(run.t / speed) for run in runs]
    motions = [motion(run, at) for run, at in zip(runs, rows, strict=True)]
    drawing = _surroundings(runs[0].mechanism, motions)
    tracks: list[tuple[str, Array, Array, Array]] = []
    for k, (run, at, moved) in enumerate(zip(runs, rows, motions, strict=True)):
        root = _run_path(runs, k)
        drawing += _bodies(run.mechanism, root, moved, OPACITY if k else 1.0)
        drawing += [commands.polyline(f"{root}/trace:{_safe(name)}", path, TRACE, OPACITY if k else 1.0)
                    for name, path in run.points.items()]  # fmt: skip
        for joint in range(1, run.mechanism.tree.model.njoints):
            position, quaternion = moved.translation[:, joint], _quaternions(moved.rotation[:, joint])
            tracks.append((_body_path(run.mechanism, root, joint), run.t[at] / speed, position, quaternion))
    return [*drawing, commands.set_animation(tracks)]


def _keyframes(t: Array) -> IntArray:
    """Output instants to show: all, or where there are more than `KEYFRAMES` a second those nearest to that rate."""
    wanted = np.arange(math.ceil((t[-1] - t[0]) * KEYFRAMES) + 1) / KEYFRAMES + t[0]
    if len(wanted) >= len(t):
        return np.arange(len(t))
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    nearest = after - (wanted - t[after - 1] < t[after] - wanted)
    return np.unique(np.append(nearest, len(t) - 1))


def _quaternions(rotations: Array) -> Array:
    """Return unit quaternions x, y, z, w of rotations (m, 3, 3), without jumps of sign between instants."""
    quaternions = np.array([pin.Quaternion(rotation).coeffs() for rotation in rotations])
    jumps = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    return quaternions


# --- names in the viewer's tree ------------------------------------------------------------------


def _run_path(runs: Sequence[Run], k: int) -> str:
    return f"{WORLD}/{k + 1}: {_safe(run_labels(runs)[k])}"


def _body_path(mechanism: Mechanism, root: str, joint: int) -> str:
    return f"{root}/joint:{_safe(mechanism.tree.model.names[joint])}" if joint else f"{root}/base"


def _safe(name: str) -> str:
    """Return a name as one step of a path."""
    return name.replace("%", "%25").replace("/", "%2F")


# --- objects -------------------------------------------------------------------------------------


def _bodies(mechanism: Mechanism, root: str, moved: Motion, opacity: float) -> Iterator[Command]:
    shapes = visuals(mechanism)
    colours = _colours(mechanism)
    own = {shape.joint: shape.colour for shape in reversed(shapes) if shape.joint}
    told_apart = None not in own.values() and len(set(own.values())) == len(own)  # by the URDF's own colours
    for k, shape in enumerate(shapes):
        colour = shape.colour if shape.colour and (told_apart or not shape.joint) else colours[shape.joint]
        path = f"{_body_path(mechanism, root, shape.joint)}/link:{_safe(shape.link)}/{k}"
        yield commands.body(path, shape.shape, shape.size, shape.placement, commands.material(colour, opacity))
    yield from _sticks(mechanism, root, moved, {shape.joint for shape in shapes}, opacity)
    yield from _loop_frames(mechanism, root, opacity)


def _colours(mechanism: Mechanism) -> list[Colour]:
    return [BASE, *(LINKS[k % len(LINKS)] for k in range(mechanism.tree.model.njoints - 1))]


def _sticks(mechanism: Mechanism, root: str, moved: Motion, drawn: set[int], opacity: float) -> Iterator[Command]:
    """Draw bodies that have no shapes of their own as rods with a ball at their joint, and rails of slides thinner."""
    thick = 0.03 * mechanism.size
    colours = _colours(mechanism)
    for joint in range(1, mechanism.tree.model.njoints):
        if joint not in drawn:
            look = commands.material(colours[joint], opacity)
            yield commands.body(f"{_body_path(mechanism, root, joint)}/ball", "sphere", [1.4 * thick], np.eye(4), look)
    for k, stick in enumerate(sticks(mechanism)):
        if stick.joint in drawn:
            continue
        rail = stick.joint != stick.end_joint
        start, end = _rail(stick, moved) if rail else (stick.start, stick.end)
        length = float(np.linalg.norm(end - start))
        if length > 1e-9 * mechanism.size:
            path = f"{_body_path(mechanism, root, stick.joint)}/{'rail' if rail else 'rod'}:{k}"
            look = commands.material(colours[stick.joint], opacity)
            yield commands.body(path, "cylinder", [0.5 * thick if rail else thick, length], _along(start, end), look)


def _rail(stick: Stick, moved: Motion) -> tuple[Array, Array]:
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


def _loop_frames(mechanism: Mechanism, root: str, opacity: float) -> Iterator[Command]:
    """Draw frames A (dark, small) and B (light, larger) of every loop, seen through everything else."""
    for loop in mechanism.spec.loop:
        for side, frame, colour, radius in (("B", loop.frame_b, FRAME_B, 0.03), ("A", loop.frame_a, FRAME_A, 0.018)):
            at = mechanism.frames.find(frame, f"loop {loop.name!r}")
            placement = np.eye(4)
            placement[:3, :3], placement[:3, 3] = at.rotation, at.translation
            path = f"{_body_path(mechanism, root, at.joint)}/loop:{_safe(loop.name)}:{side}"
            look = commands.material(colour, opacity, on_top=True)
            yield commands.body(path, "sphere", [radius * mechanism.size], placement, look)


# --- camera, ground, light -----------------------------------------------------------------------


def _surroundings(mechanism: Mechanism, motions: Sequence[Motion]) -> list[Command]:
    """Face the mechanism, with all of its motion in sight, before or above a grid whose squares have a round size.

    The viewer always looks at the origin of its scene with z up, so the scene moves: `WORLD` is placed with the
    middle of the motion at the origin, up along z and the viewer's side along -y. The camera is level with a planar
    mechanism, and above any other.
    """
    view, height = viewpoint(mechanism), 0.0
    if not is_planar(mechanism):
        up = upward(mechanism)
        view, height = np.array([view[0], up, np.cross(view[0], up)]), float(view[2] @ up)
    low, high = _extent(mechanism, motions, view)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = max(float(half[0]), float(half[1]), 0.5 * mechanism.size)
    distance = 1.25 * reach / math.tan(math.radians(0.5 * FIELD_OF_VIEW)) + float(half[2])
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # right, up, towards to the scene's x, y, z
    square = 10.0 ** math.floor(math.log10(reach)) / 0.5  # the viewer's own squares are 0.5 m
    if is_planar(mechanism):  # a wall behind it
        grid = _frame(square * turn, np.array([0.0, half[2] + 0.3 * mechanism.size, 0.0]))
    else:  # a floor
        grid = _frame(square * np.eye(3), np.array([0.0, 0.0, -half[1] - 0.1 * mechanism.size]))
    camera = "/Cameras/default/rotated/<object>"  # in this frame y is up and the viewer looks along -z
    return [
        commands.set_property("/Background", "top_color", [1.0, 1.0, 1.0]),
        commands.set_property("/Background", "bottom_color", [0.90, 0.92, 0.95]),
        commands.set_property("/Axes", "visible", False),
        commands.set_property("/Grid", "color", [1.0, 1.0, 1.0, 0.25]),
        commands.set_transform("/Grid", grid),
        commands.set_transform(WORLD, _frame(turn @ view, -turn @ centre)),
        commands.set_property(camera, "fov", FIELD_OF_VIEW),
        commands.set_property(camera, "near", 0.01 * distance),
        commands.set_property(camera, "far", 100.0 * distance),
        commands.set_property(camera, "position", [0.0, height * distance, math.sqrt(1 - height**2) * distance]),
    ]


def _extent(mechanism: Mechanism, motions: Sequence[Motion], view: Array) -> tuple[Array, Array]:
    """Bounds of every stick along the whole of the motions, in the viewer's axes."""
    ends = [
        moved.of(joint, point)
        for moved in motions
        for stick in sticks(mechanism)
        for joint, point in ((stick.joint, stick.start), (stick.end_joint, stick.end))
    ]
    seen = np.concatenate(ends) @ view.T if ends else np.zeros((1, 3))
    return seen.min(axis=0), seen.max(axis=0)


def _frame(axes: Array, origin: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, origin
    return matrix


def _caption(runs: Sequence[Run], speed: float) -> tuple[str, list[str]]:
    lines = [f"{'translucent: ' if k else ''}{label}" for k, label in enumerate(run_labels(runs))]
    pace = "" if speed == 1 else f"; {speed:g} s a second"
    return runs[0].scene_name, [*lines, f"{max(run.t[-1] for run in runs):g} s{pace}"]
