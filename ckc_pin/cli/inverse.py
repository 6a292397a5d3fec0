"""What a motion asks of motors, loops and joints: inverse."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder
from ckc_pin.cli import options
from ckc_pin.cli.arguments import read_overrides
from ckc_pin.cli.exits import STOPPED, interrupted
from ckc_pin.cli.output import ProgressBar, errors, kept, make_folder, print_json, print_table
from ckc_pin.cli.signals import interrupts
from ckc_pin.cli.tables import inverse_table
from ckc_pin.errors import InputError

__all__ = ["inverse"]


@click.command(
    epilog=options.examples(
        "ckc inverse five_bar/tracking --out forces --figures",
        "ckc inverse five_bar/tracking --set controller.torque_limit=1.2 --json",
        "ckc inverse runs/spf",
    )
)
@click.argument(
    "what",
    metavar="SCENE|RUN",
    shell_complete=options.complete_scenes,
    help="A scene with a desired motion, or a run: its file or its folder.",
)
@options.overrides
@options.out(help="Folder for inverse.npz.")
@options.figures
@options.as_json
def inverse(what: str, overrides: tuple[str, ...], out: Path | None, figures: bool, as_json: bool) -> None:
    """Motor torques, loop and joint forces along a motion. The scene's desired one, or that of a run."""
    options.require_folder(out, figures)
    if out is not None:
        make_folder(out)
    with ProgressBar(what) as progress:
        found = ckc_pin.inverse_dynamics(what, read_overrides("--set", overrides), progress=progress)
    if out is not None:
        _write(found, out, figures)
    if as_json:
        print_json(found.to_dict())
    else:
        print_table(inverse_table(found))
        print(kept(out, "inverse.npz, for other programs"))
    sys.stdout.flush()
    if found.status != "done":
        errors().print(found.message)
        raise click.exceptions.Exit(STOPPED if found.status == "stopped" else interrupted(found.message))


def _write(found: ckc_pin.MotionForces, out: Path, figures: bool) -> None:
    """Save the forces, whatever signals come, then draw them if that is asked for."""
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            found.save(out / "inverse.npz")
        if not figures:
            return
        try:
            from ckc_pin.view.result_figures import save_motion_forces

            save_motion_forces(found, out)
        except InputError as error:  # matplotlib is an extra; the forces are saved
            errors().print(f"no figure: {error}")
