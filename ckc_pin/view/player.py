"""Playback of saved runs in meshcat's viewer: in the browser, or as one HTML file."""

from __future__ import annotations

import math
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
from ckc_pin.view.bodies import missing_meshes
from ckc_pin.view.browser import open_in_browser
from ckc_pin.view.commands import Command
from ckc_pin.view.drawing import scene
from ckc_pin.view.given_runs import given_runs
from ckc_pin.view.labels import run_labels
from ckc_pin.view.page import page, standalone
from ckc_pin.view.style import drawing_order

if TYPE_CHECKING:
    from ckc_pin.view.server import ViewServer

__all__ = ["caption", "file_in_folder", "html", "play", "save_html", "shown_runs", "write_page"]


def play(
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

    The reduced model is solid, and a DAE or an SPF beside it translucent.

    Parameters
    ----------
    runs : Run or sequence of Run
    speed : float
        Seconds of the run in a second of playback, to begin with.
    gap : float
        Above zero: how many times larger the gaps of the loops are drawn.
    meshes : path, optional
        The mechanism's folder, where the URDF's mesh files are: a run file has none. Links whose meshes are missing
        are drawn as sticks.
    forces : bool
        Draw what the loops carry and what the motors give as arrows; the page can hide them.
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
    require_flag(open_browser, "play: open_browser")
    require_flag(block, "play: block")
    require_flag(forces, "play: forces")
    require_type(port, int, "play: port", "a port from 1 to 65535, or 0 for any free one")
    ordered, drawing = _drawing(runs, speed, gap, meshes, forces)
    try:
        from ckc_pin.view.server import ViewServer
    except ModuleNotFoundError:
        raise InputError("playback needs meshcat and its tornado: pip install 'ckc_pin[view]'") from None
    server = ViewServer(page(*caption(ordered, gap, forces)), port)
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


def save_html(
    runs: Run | Sequence[Run],
    path: str | Path,
    *,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
) -> Path:
    """Write runs as one HTML file that plays from disk, without a network. Parameters as for `play`.

    Raises
    ------
    InputError
        As for `play`; a file that cannot be written.
    """
    return write_page(html(runs, speed=speed, gap=gap, meshes=meshes, forces=forces), path)


def write_page(text: str, path: str | Path) -> Path:
    """Write a page as `save_html` does."""
    path = file_in_folder(path, "save_html: path")
    write_atomic(path, text)
    return path


def file_in_folder(path: str | Path, who: str) -> Path:
    """Return where to write a file (InputError where its folder is not there)."""
    require_path(path, who)
    path = Path(path)
    if not isdir(path.parent):
        raise InputError(f"{path}: cannot be written: No such file or directory; choose a file in a folder that exists")
    return path


def shown_runs(runs: Run | Sequence[Run], speed: float) -> list[Run]:
    """Return the runs that lie on each other, those with thin lines last (InputError where they cannot be shown)."""
    runs = given_runs(runs, "play")
    if not (is_number(speed) and math.isfinite(speed) and speed > 0):
        raise InputError(f"play: speed = {speed!r:.80}; it must be a number above zero, 1 is real time")
    _require_one_tree(runs)
    return drawing_order(runs)


def html(
    runs: Run | Sequence[Run],
    *,
    speed: float = 1.0,
    gap: float = 0.0,
    meshes: str | Path | None = None,
    forces: bool = False,
) -> str:
    """Return the page that `save_html` writes, for what shows pages in a place of its own."""
    ordered, drawing = _drawing(runs, speed, gap, meshes, forces)
    return standalone(*caption(ordered, gap, forces), drawing)


def _drawing(
    runs: Run | Sequence[Run], speed: float, gap: float, meshes: str | Path | None, forces: bool
) -> tuple[list[Run], list[Command]]:
    ordered = shown_runs(runs, speed)
    if not (is_number(gap) and math.isfinite(gap) and gap >= 0):
        raise InputError(f"play: gap = {gap!r:.80}; it says how many times larger gaps are drawn, 0 draws none")
    if meshes is not None:
        require_path(meshes, "play: meshes", "the mechanism's folder")
    folder = None if meshes is None else Path(meshes)
    if folder is not None and not isdir(folder):
        raise InputError(f"play: meshes = {folder}: no such folder; give the one that the mechanism.toml is in")
    drawing = scene(ordered, speed=speed, gap=gap, meshes=folder, forces=forces)
    missing = list(dict.fromkeys(name for run in ordered for name in missing_meshes(run.mechanism, folder)))
    if missing:
        shown = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        print(f"meshes missing, so sticks: {shown}; --meshes FOLDER says where they are", file=sys.stderr)
    return ordered, drawing


def _require_one_tree(runs: Sequence[Run]) -> None:
    first = runs[0]
    other = next((run for run in runs if run.coordinates != first.coordinates), None)
    if other is not None:
        raise InputError(
            f"play: {first.scene_name} is a run of {first.mechanism.name}, {other.scene_name} of "
            f"{other.mechanism.name}, which has other coordinates; only runs of one mechanism lie on each other: play "
            "them one by one"
        )


def caption(runs: Sequence[Run], gap: float = 0.0, forces: bool = False) -> tuple[str, list[str]]:
    """Return the title of a page that shows runs, and the lines below it."""
    lines = [f"{'translucent: ' if k else ''}{label}" for k, label in enumerate(run_labels(runs))]
    if any("controller" in run.scene for run in runs):
        lines.append("gray: desired")
    if gap > 0:
        lines.append(f"red: gaps of the loops, {gap:g} times larger")
    if forces:
        lines.append("green: forces of the loops; purple: of the motors")
    return runs[0].scene_name, lines
