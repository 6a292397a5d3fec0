"""Playback of runs in meshcat's viewer: in the browser, or as one HTML file."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from os.path import isdir
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.validation import is_number, require_flag, require_path, require_type
from ckc_pin.errors import InputError
from ckc_pin.run.run import Run
from ckc_pin.view.bodies import find_missing_meshes
from ckc_pin.view.commands import Command
from ckc_pin.view.drawing import draw_runs_3d
from ckc_pin.view.page import render_saved_page, render_server_page
from ckc_pin.view.run_group import require_runs
from ckc_pin.view.style import label_runs, sort_for_drawing

if TYPE_CHECKING:
    from ckc_pin.view.server import ViewServer

__all__ = ["open_in_browser", "play_runs", "render_html", "require_parent_folder", "require_playable_runs",
           "save_html", "start_server", "write_page"]  # fmt: skip

MAX_LISTED_MESHES = 3


def play_runs(
    runs: Run | Sequence[Run],
    *,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
    open_browser: bool = False,
    port: int = 0,
    block: bool = True,
) -> ViewServer | None:
    """Play runs back in the browser, on this machine only.

    The first run is opaque and the others are translucent. The reduced model comes first.

    Parameters
    ----------
    runs : Run or sequence of Run
    speed : float
        Simulated seconds per second of playback; the page can change it.
    gap : float
        Above zero: factor by which the gaps of the loops are magnified.
    meshes : path, optional
        The mechanism's folder, which contains the URDF's mesh files; run files do not contain them. Links without
        their meshes are drawn as rods.
    forces : bool
        Draw constraint forces of loops and motor efforts as arrows; the page can hide them.
    open_browser : bool
        Also open the address in the default browser.
    port : int
        On 127.0.0.1; 0: any free port.
    block : bool
        Print the address and wait until Ctrl-C. Otherwise return the server, which runs until its `stop`.

    Returns
    -------
    ViewServer or None

    Raises
    ------
    InputError
        No run, a speed that is not positive, a port in use, meshcat not installed, or an invalid visual in a URDF.
    """
    require_flag(open_browser, "play: open_browser")
    require_flag(block, "play: block")
    require_flag(forces, "play: forces")
    require_type(port, int, "play: port", "a port from 1 to 65535, or 0 for any free one")
    ordered, drawing = _draw(runs, speed, gap, meshes, forces)
    server = start_server(*_describe(ordered, gap, forces), port)
    for command in drawing:
        server.send(command)
    if open_browser:
        open_in_browser(server.url)
    if not block:
        return server
    with server:
        try:
            print(f"{server.url}  (Ctrl-C ends)", flush=True)
            Event().wait()
        except KeyboardInterrupt as stop:
            acknowledge(stop)
            print()
    return None


def start_server(title: str, lines: Sequence[str], port: int) -> ViewServer:
    """Start a server for a page with a title and lines of plain text (InputError if its packages are missing)."""
    try:
        from ckc_pin.view.server import ViewServer
    except ModuleNotFoundError:
        raise InputError("playback needs meshcat and tornado: pip install 'ckc_pin[view]'") from None
    return ViewServer(render_server_page(title, lines), port)


def open_in_browser(url: str) -> None:
    """Open an address in the default browser, or print on standard error that this is not possible."""
    import webbrowser

    has_display = sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if not has_display:  # A text browser would take over the terminal.
        print(f"no display here; open {url} in a browser on this machine", file=sys.stderr)
    elif not webbrowser.open(url):
        print(f"no browser could be opened; open {url} in yours", file=sys.stderr)


# --- files ---------------------------------------------------------------------------------------


def save_html(
    runs: Run | Sequence[Run],
    path: str | Path,
    *,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
) -> Path:
    """Write runs as one HTML file that plays from disk, without a network. Parameters as for `play_runs`.

    Raises
    ------
    InputError
        As for `play_runs`; the file cannot be written.
    """
    return write_page(render_html(runs, speed=speed, gap=gap, meshes=meshes, forces=forces), path)


def write_page(text: str, path: str | Path) -> Path:
    """Write the text of a page to a file (InputError if it cannot be written)."""
    path = require_parent_folder(path, "save_html: path")
    write_atomic(path, text)
    return path


def require_parent_folder(path: str | Path, where: str) -> Path:
    """Return the path of a file to be written (InputError if its folder does not exist)."""
    require_path(path, where)
    path = Path(path)
    if not isdir(path.parent):
        raise InputError(f"{path}: cannot be written: No such file or directory; choose a file in a folder that exists")
    return path


def render_html(
    runs: Run | Sequence[Run],
    *,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
) -> str:
    """Return the text of the page that `save_html` writes."""
    ordered, drawing = _draw(runs, speed, gap, meshes, forces)
    return render_saved_page(*_describe(ordered, gap, forces), drawing)


# --- runs ----------------------------------------------------------------------------------------


def require_playable_runs(runs: Run | Sequence[Run], speed: float) -> list[Run]:
    """Return runs in drawing order (InputError if they cannot be played together, or not at this speed)."""
    runs = require_runs(runs, "play")
    if not (is_number(speed) and math.isfinite(speed) and speed > 0):
        raise InputError(f"play: speed = {speed!r:.80}; it must be a number above zero, 1 is real time")
    first = runs[0]
    other = next((run for run in runs if run.coordinates != first.coordinates), None)
    if other is not None:
        raise InputError(
            f"play: {first.scene_name} is a run of {first.mechanism.name}, but {other.scene_name} is a run of "
            f"{other.mechanism.name}, which has other coordinates; play runs of different mechanisms one by one"
        )
    return sort_for_drawing(runs)


def _draw(
    runs: Run | Sequence[Run], speed: float, gap: float, meshes: str | Path | None, forces: bool
) -> tuple[list[Run], list[Command]]:
    """Return runs in drawing order and their drawing commands; print which mesh files are missing."""
    ordered = require_playable_runs(runs, speed)
    if not (is_number(gap) and math.isfinite(gap) and gap >= 0):
        raise InputError(f"play: gap = {gap!r:.80}; it must be a factor by which gaps are magnified, or 0 for no gaps")
    if meshes is not None:
        require_path(meshes, "play: meshes", "the mechanism's folder")
    folder = None if meshes is None else Path(meshes)
    if folder is not None and not isdir(folder):
        raise InputError(f"play: meshes = {folder}: no such folder; give the folder of the mechanism.toml")
    drawing = draw_runs_3d(ordered, speed=speed, gap=gap, meshes=folder, forces=forces)
    missing = list(dict.fromkeys(name for run in ordered for name in find_missing_meshes(run.mechanism, folder)))
    if missing:
        remaining = len(missing) - MAX_LISTED_MESHES
        listed = ", ".join(missing[:MAX_LISTED_MESHES]) + (f" and {remaining} more" if remaining > 0 else "")
        print(f"mesh files not found: {listed}; links are drawn as rods. --meshes DIR names their folder",
              file=sys.stderr)  # fmt: skip
    return ordered, drawing


def _describe(runs: Sequence[Run], gap: float, forces: bool) -> tuple[str, list[str]]:
    """Return the title of a page that shows runs, and the lines of its caption."""
    lines = [f"{'translucent: ' if k else ''}{label}" for k, label in enumerate(label_runs(runs))]
    if any("controller" in run.scene for run in runs):
        lines.append("gray: desired")
    if gap > 0:
        lines.append(f"red: gaps of the loops, {gap:g} times larger")
    if forces:
        lines.append("green: forces of the loops; purple: of the motors")
    return runs[0].scene_name, lines
