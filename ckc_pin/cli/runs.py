"""Commands for runs: run, plot, play."""

from __future__ import annotations

import json
import re
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder, write_atomic
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    ProgressBar,
    Spinner,
    create_table,
    error_console,
    format_destination,
    make_folder,
    print_json,
    print_summary,
    print_written,
    require_file_path,
    skip_figures_without_matplotlib,
    write_csv,
    write_file,
)
from ckc_pin.cli.signals import DONE, STOPPED, interrupt_code, interrupts
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["format_profile", "play", "plot", "run"]


# --- run -----------------------------------------------------------------------------------------


@click.command(
    epilog=options.format_examples(
        "ckc run five_bar/tracking --out runs/spf",
        "ckc run five_bar/tracking --set formulation=reduced --set solver.rtol=1e-10 --json",
        "ckc run five_bar/tracking --csv tracking.csv",
        "ckc run delta --mcap delta.mcap",
        "ckc run five_bar/tracking --meshcat --speed 1",
        "ckc run . --out first --figures",
    )
)
@click.argument(
    "what",
    metavar="SCENE",
    shell_complete=options.complete_scenes,
    help="A shipped name or a file; or a mechanism's name or folder, for its default scene.",
)
@options.overrides
@options.out(help="Folder for run.npz and for scene.json, the scene with all defaults.")
@options.figures
@options.csv(help="Also write the run as a CSV file, a row for each output instant; columns are named quantities.")
@click.option(
    "--mcap",
    metavar="FILE",
    type=options.PATH,
    help="Also write joint states, frames and wrenches for Foxglove and ROS 2.",
)
@click.option("--profile", is_flag=True, help="Print how often each term was evaluated and the time it took.")
@click.option(
    "--meshcat", is_flag=True, help="Show the simulation in the browser, then play it back; Ctrl-C ends the command."
)
@click.option(
    "--speed", metavar="FACTOR", type=float, help="With --meshcat: 1 is real time; default: as fast as it is computed."
)
@options.port
@options.open_browser
@options.as_json
def run(
    what: str,
    overrides: dict[str, Any],
    out: Path | None,
    figures: bool,
    csv: Path | None,
    mcap: Path | None,
    profile: bool,
    meshcat: bool,
    speed: float | None,
    port: int,
    open_browser: bool,
    as_json: bool,
) -> None:
    """Simulate a scene. The outcome is printed; --out DIR saves the run."""
    from ckc_pin.run.checks import run_warnings

    options.require_folder(out, figures)
    _require_meshcat_for_view_options(meshcat, speed, port, open_browser)
    scene = ckc_pin.load_scene(what, overrides)
    warnings = run_warnings(scene)
    for warning in warnings:
        error_console().print(f"warning: {warning}")
    if out is not None:
        make_folder(out)
    require_file_path(csv, "--csv")
    require_file_path(mcap, "--mcap")
    with ExitStack() as stack:
        view = stack.enter_context(_open_live_view(scene, speed, port, open_browser)) if meshcat else None
        with ProgressBar(scene.name) as progress:
            on_output = None if view is None else view.on_output
            finished = ckc_pin.simulate(scene, progress=progress, on_output=on_output, profile=profile)
        finished = finished.with_warnings(warnings)
        code = _save_and_print(finished, out, figures, profile, as_json, warnings)
        _write_files(finished, csv, mcap, as_json)
        if view is not None and finished.status != "interrupted":
            try:
                view.finish(finished, stay=True)
            except KeyboardInterrupt as stop:
                acknowledge(stop)
    if code != DONE:
        raise click.exceptions.Exit(code)


def _save_and_print(
    finished: ckc_pin.Run, out: Path | None, figures: bool, profile: bool, as_json: bool, printed: list[str]
) -> int:
    """Save and print a run; return the exit code. Warnings that were printed before the run are not repeated."""
    stop = _save(finished, out, figures) if out is not None else None
    if profile:
        error_console().print(format_profile(finished))
    if as_json:
        print_json(finished.to_dict())
    else:
        summary = finished.summary()
        is_new = [row[0] != "warnings" and row[1] not in printed for row in summary.rows]
        print_summary(
            replace(summary, rows=[row for row, is_kept in zip(summary.rows, is_new, strict=True) if is_kept])
        )
        print(format_destination(out, "the run, for ckc play, plot and inverse"))
    sys.stdout.flush()  # A live view may keep the command running.
    if finished.status != "done":
        error_console().print(finished.message)
        return STOPPED if finished.status == "stopped" else interrupt_code(finished.message)
    return DONE if stop is None else interrupt_code(str(stop))


def _write_files(finished: ckc_pin.Run, csv: Path | None, mcap: Path | None, as_json: bool) -> None:
    write_csv(finished, csv, as_json)
    if mcap is not None:
        from ckc_pin.formats.mcap import write_mcap

        write_file(partial(write_mcap, finished), mcap, as_json)
    sys.stdout.flush()  # A live view may keep the command running.


def _require_meshcat_for_view_options(meshcat: bool, speed: float | None, port: int, open_browser: bool) -> None:
    view_options = [name for name, x in (("--speed", speed), ("--port", port), ("--open", open_browser)) if x]
    if view_options and not meshcat:
        raise InputError(f"{view_options[0]} goes with --meshcat; give both")
    if speed is not None:
        options.require_speed(speed)


def _open_live_view(scene: ckc_pin.Scene, speed: float | None, port: int, open_browser: bool) -> Any:
    from ckc_pin.view.live import live_view

    return live_view(scene, speed, port, open_browser)


def _save(finished: ckc_pin.Run, out: Path, figures: bool) -> KeyboardInterrupt | None:
    """Save a run while signals are deferred, then draw it if requested; return the interrupt if one came."""
    try:
        with ExitStack() as stack:
            with interrupts.deferred():
                stack.enter_context(lock_folder(out))
                finished.save(out / "run.npz")
                write_atomic(out / "scene.json", json.dumps(finished.scene, indent=2) + "\n")
            if figures:
                from ckc_pin.view.figures import plot_runs

                with Spinner("drawing"), skip_figures_without_matplotlib():
                    plot_runs([finished], out)
    except KeyboardInterrupt as stop:
        without = ", without figures" if figures else ""
        error_console().print(f"interrupted{acknowledge(stop)}; the run is saved{without}")
        return stop
    return None


def format_profile(run: ckc_pin.Run) -> Table:
    """Return a table of the terms that a run evaluated, how often and for how long."""
    table = create_table("term", right=("evaluated", "ms"))
    for name, cost in run.profile.items():
        table.add_row(name, str(cost["calls"]), f"{1e3 * cost['seconds']:.2f}")
    return table


# --- plot and play -------------------------------------------------------------------------------


@click.command(epilog=options.format_examples("ckc plot runs/reduced runs/spf --out figures"))
@options.runs
@options.out(default=Path(), help="Folder for the figures; default: the current one.")
def plot(runs: tuple[Path, ...], out: Path) -> None:
    """Draw figures of runs as PNG and SVG. Comparable runs share a figure."""
    from ckc_pin.view.figures import plot_runs

    with Spinner("drawing"):
        paths = plot_runs([ckc_pin.Run.load(path) for path in runs], out, ("png", "svg"))
    print_written(paths)


@click.command(
    epilog=options.format_examples(
        "ckc play runs/spf",
        "ckc play runs/reduced runs/spf --speed 0.5 --gap 1000",
        "ckc play runs/spf --html spf.html",
        "ckc play runs/reduced runs/spf --video both.gif",
        "ckc play runs/spf --video spf.gif --size 960x540 --fps 30",
    )
)
@options.runs
@click.option("--html", metavar="FILE", type=options.PATH, help="Write an HTML file that plays from disk instead.")
@click.option(
    "--video",
    "--gif",
    "video",
    metavar="FILE",
    type=options.PATH,
    help="Write an animated line drawing instead, as GIF. The player in the browser records other formats.",
)
@click.option("--size", metavar="SIZE", help="Pixels of the video, such as 960x540; default: 480 wide.")
@click.option("--fps", metavar="N", type=float, help="Frames per second of the video, 1 to 50; default: 20.")
@click.option("--speed", metavar="FACTOR", type=float, default=1.0, help="Playback speed, 1 is real time.")
@click.option("--gap", metavar="FACTOR", type=float, default=0.0, help="Draw the loops' gaps, magnified by a factor.")
@click.option("--forces", is_flag=True, help="Draw the forces of loops and motors as arrows.")
@click.option("--meshes", metavar="DIR", type=options.PATH, help="The mechanism's folder, for its mesh files.")
@options.port
@options.open_browser
def play(
    runs: tuple[Path, ...],
    html: Path | None,
    video: Path | None,
    size: str | None,
    fps: float | None,
    speed: float,
    gap: float,
    forces: bool,
    meshes: Path | None,
    port: int,
    open_browser: bool,
) -> None:
    """Play runs in the browser, on this machine only. Several runs are drawn on top of each other."""
    options.require_speed(speed)
    if video is not None and video.suffix.lower() != ".gif":
        raise InputError(
            f"--video {video}: expected a name that ends in .gif, the only format that is written; "
            f"ffmpeg -i {video.with_suffix('.gif').name} {video.name} converts it"
        )
    if video is not None and (html is not None or gap or forces or meshes is not None):
        raise InputError(
            "--video goes with --size, --fps and --speed only; leave out --html, --gap, --forces and --meshes"
        )
    if video is None and (size is not None or fps is not None):
        raise InputError(f"{'--fps' if size is None else '--size'} goes with --video FILE; give both")
    pixels = None if size is None else _read_size(size)
    loaded = [ckc_pin.Run.load(path) for path in runs]
    if video is not None:
        from ckc_pin.view.gif import FRAMES_PER_SECOND, save_gif

        with Spinner(f"writing {video.name}"):
            path = save_gif(loaded, video, speed=speed, size=pixels, fps=FRAMES_PER_SECOND if fps is None else fps)
        print_written([path])
        return
    if html is None:
        ckc_pin.play(*loaded, speed=speed, gap=gap, meshes=meshes, forces=forces, port=port, open_browser=open_browser)
        return
    from ckc_pin.view.player import save_html

    with Spinner(f"writing {html.name}"):
        path = save_html(loaded, html, speed=speed, gap=gap, meshes=meshes, forces=forces)
    print_written([path])


def _read_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,9})[xX×](\d{1,9})", text)
    if match is None:
        raise InputError(f"--size {text}: expected width and height in pixels, such as 960x540")
    return int(match[1]), int(match[2])
