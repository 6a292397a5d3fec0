"""How a run changes with its parameters: sensitivities."""

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
from ckc_pin.cli.output import ProgressBar, errors, kept, make_folder, print_json, print_summary
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError

__all__ = ["sensitivities"]


@click.command(
    epilog=options.examples(
        "ckc sensitivities five_bar/swing link.link_2.mass gravity.y",
        "ckc sensitivities five_bar/set_point controller.K_P joint.theta_2.xyz.x --out changes --figures",
    )
)
@click.argument(
    "scene", metavar="SCENE", shell_complete=options.complete_scenes, help="A scene, or a mechanism's name."
)
@click.argument(
    "parameters",
    metavar="NAME...",
    nargs=-1,
    required=True,
    help="Numbers of the mechanism, of the controller or of the start, as link.rod.mass or initial.q.crank.",
)
@options.overrides
@options.out(help="Folder for sensitivities.npz and run.npz.")
@options.figures
@options.as_json
def sensitivities(
    scene: str, parameters: tuple[str, ...], overrides: tuple[str, ...], out: Path | None, figures: bool, as_json: bool
) -> None:
    """How a run changes with parameters, to first order. Exact, through impacts and sticking."""
    options.require_folder(out, figures)
    if out is not None:
        make_folder(out)
    with ProgressBar(scene) as progress:
        found = ckc_pin.sensitivities(scene, parameters, read_overrides("--set", overrides), progress)
    if out is not None:
        _write(found, out, figures)
    if as_json:
        print_json(found.to_dict())
    else:
        print_summary(found.summary())
        print(kept(out, "sensitivities.npz, for other programs"))
    sys.stdout.flush()
    if found.run.status != "done":
        errors().print(found.run.message)
        raise click.exceptions.Exit(STOPPED if found.run.status == "stopped" else interrupted(found.run.message))


def _write(found: ckc_pin.Sensitivities, out: Path, figures: bool) -> None:
    """Save them and the run, whatever signals come, then draw them if that is asked for."""
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            found.save(out / "sensitivities.npz")
            found.run.save(out / "run.npz")
        if not figures:
            return
        try:
            ckc_pin.plot(found).save(out)
        except InputError as error:  # matplotlib is an extra; the numbers are saved
            errors().print(f"no figure: {error}")
