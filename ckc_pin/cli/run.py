"""Simulate a scene: run."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder, write_atomic
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.cli import options
from ckc_pin.cli.arguments import read_overrides
from ckc_pin.cli.exits import DONE, STOPPED, interrupted
from ckc_pin.cli.output import ProgressBar, Working, errors, kept, make_folder, print_json, print_summary
from ckc_pin.cli.signals import interrupts
from ckc_pin.cli.tables import profile_table
from ckc_pin.errors import InputError
from ckc_pin.run.checks import run_warnings

__all__ = ["run"]


@click.command(
    epilog=options.examples(
        "ckc run five_bar/tracking --out runs/spf",
        "ckc run five_bar/tracking --set formulation=reduced --set solver.rtol=1e-10 --json",
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
@options.out(help="Folder for run.npz and the scene as resolved.")
@options.figures
@click.option("--profile", is_flag=True, help="Print which terms were evaluated, how often.")
@click.option("--meshcat", is_flag=True, help="Show it in the browser while it computes, then play it, until Ctrl-C.")
@click.option(
    "--speed", metavar="FACTOR", type=float, help="With --meshcat: 1 is real time; absent: as it is computed."
)
@options.port
@options.open_browser
@options.as_json
def run(
    what: str,
    overrides: tuple[str, ...],
    out: Path | None,
    figures: bool,
    profile: bool,
    meshcat: bool,
    speed: float | None,
    port: int,
    open_browser: bool,
    as_json: bool,
) -> None:
    """Simulate a scene. Its outcome is printed; --out DIR keeps it."""
    options.require_folder(out, figures)
    _check_view_options(meshcat, speed, port, open_browser)
    scene = ckc_pin.load_scene(what, read_overrides("--set", overrides))
    for warning in run_warnings(scene):
        errors().print(f"warning: {warning}")
    if out is not None:
        make_folder(out)
    with ExitStack() as stack:
        view = stack.enter_context(_view(scene, speed, port, open_browser)) if meshcat else None
        with ProgressBar(scene.name) as progress:
            on_output = None if view is None else view.on_output
            finished = ckc_pin.simulate(scene, progress=progress, on_output=on_output, profile=profile)
        code = _report(finished, out, figures, profile, as_json)
        if view is not None and finished.status != "interrupted":
            try:
                view.finish(finished, stay=True)
            except KeyboardInterrupt as stop:
                acknowledge(stop)
    if code != DONE:
        raise click.exceptions.Exit(code)


def _report(finished: ckc_pin.Run, out: Path | None, figures: bool, profile: bool, as_json: bool) -> int:
    """Write and print a run; return the exit code."""
    stop = _write(finished, out, figures) if out is not None else None
    if profile:
        errors().print(profile_table(finished))
    if as_json:
        print_json(finished.to_dict())
    else:
        print_summary(finished.summary())
        print(kept(out, "the run, for ckc play, plot and inverse"))
    sys.stdout.flush()  # a view may keep the command alive
    if finished.status != "done":
        errors().print(finished.message)
        return STOPPED if finished.status == "stopped" else interrupted(finished.message)
    return DONE if stop is None else interrupted(str(stop))


def _check_view_options(meshcat: bool, speed: float | None, port: int, open_browser: bool) -> None:
    given = [name for name, x in (("--speed", speed), ("--port", port), ("--open", open_browser)) if x]
    if given and not meshcat:
        raise InputError(f"{given[0]} goes with --meshcat; give both")
    if speed is not None:
        options.check_speed(speed)


def _view(scene: ckc_pin.Scene, speed: float | None, port: int, open_browser: bool) -> Any:
    from ckc_pin.view.live import live_view

    return live_view(scene, speed, port, open_browser)


def _write(finished: ckc_pin.Run, out: Path, figures: bool) -> KeyboardInterrupt | None:
    """Save a run, whatever signals come, then draw it if that is asked for; return what interrupted that."""
    try:
        with ExitStack() as stack:
            with interrupts.deferred():
                stack.enter_context(lock_folder(out))
                finished.save(out / "run.npz")
                write_atomic(out / "scene.json", json.dumps(finished.scene, indent=2) + "\n")
            if figures:
                with Working("drawing"):
                    _draw(finished, out)
    except KeyboardInterrupt as stop:
        errors().print(f"interrupted{acknowledge(stop)}; the run is saved{', without figures' if figures else ''}")
        return stop
    return None


def _draw(finished: ckc_pin.Run, out: Path) -> None:
    try:
        from ckc_pin.view.figures import plot_runs

        plot_runs([finished], out)
    except InputError as error:  # matplotlib is an extra; the run itself is saved
        errors().print(f"no figures: {error}")
