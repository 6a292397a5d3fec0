"""What a mechanism does near one state: linearize."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder
from ckc_pin.cli import options
from ckc_pin.cli.arguments import read_overrides, read_table
from ckc_pin.cli.output import ProgressBar, Working, errors, make_folder, print_json, print_summary
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import CkcError, InputError
from ckc_pin.linear.linearize import At

__all__ = ["linearize"]

OF_MODEL = re.compile(r"mode_\d+\.npz|(poles|modes|locus)\.png")  # not always written again


@click.command(
    epilog=options.examples(
        "ckc linearize five_bar --at equilibrium --json",
        'ckc linearize five_bar --at \'{"theta_1": -1.2, "theta_3": -1.9}\'',
        "ckc linearize five_bar/tracking --at 2.5",
        "ckc linearize stewart --out modes; ckc play modes/mode_1.npz",
        "ckc linearize bricard/period --period 4.99171151369",
    )
)
@click.argument("what", metavar="MECHANISM|SCENE", help="A mechanism or a scene.")
@click.option(
    "--at",
    metavar="equilibrium|assembled|target|T|JSON",
    help="About the stable equilibrium (what is taken without it), an instant of the scene's run in s, or as "
    "assembled, at the set point's target or at coordinates, held by its motors.",
)
@click.option(
    "--period",
    metavar="SECONDS",
    type=float,
    help="Instead along the scene's motion, which comes back after this time: monodromy matrix, Floquet multipliers.",
)
@options.overrides
@click.option(
    "--out",
    metavar="DIR",
    type=options.PATH,
    help="Folder for linear.npz, figures, and the modes as runs to play; of a period floquet.npz and run.npz.",
)
@options.as_json
def linearize(
    what: str, at: str | None, period: float | None, overrides: tuple[str, ...], out: Path | None, as_json: bool
) -> None:
    """Linear model in minimal coordinates: A, B, C, D, modes. Exact, about a state of rest or of a run."""
    if at is not None and period is not None:
        raise InputError("--at and --period are both given: one is about a state, the other along a motion; give one")
    if out is not None:
        make_folder(out)
    if period is not None:
        with ProgressBar(what) as progress:
            found = ckc_pin.floquet(what, period, read_overrides("--set", overrides), progress)
        if out is not None:
            _write_floquet(found, out)
        _print(found, out, as_json)
        return
    with Working(f"linearizing {what}"):
        model = ckc_pin.linearize(what, _at("equilibrium" if at is None else at), read_overrides("--set", overrides))
    runs, modes = 0 if out is None else _write(model, what, overrides, out), len(model.modes)
    barred = "rigid ones do not, nor any whose swing the loops do not follow, nor more than twelve"
    more = "" if runs == modes else f"; {runs} of {modes} modes can be played: {barred}"
    _print(model, out, as_json, more)


def _print(result: ckc_pin.LinearModel | ckc_pin.Floquet, out: Path | None, as_json: bool, more: str = "") -> None:
    if as_json:
        print_json(result.to_dict())
        return
    print_summary(result.summary())
    if out is not None:
        print(f"written to {out}{more}")


def _at(given: str) -> At:
    if given in ("equilibrium", "assembled", "target"):
        return given
    if given.lstrip().startswith("{"):
        return read_table("--at", given)
    try:
        return float(given)
    except ValueError:
        raise InputError(
            f"--at {given!r:.80}: give equilibrium, assembled, target, a time in seconds, or a table of coordinates as "
            "JSON"
        ) from None


def _write_floquet(found: ckc_pin.Floquet, out: Path) -> None:
    with interrupts.deferred(), ExitStack() as stack:
        stack.enter_context(lock_folder(out))
        found.save(out / "floquet.npz")
        found.run.save(out / "run.npz")


def _write(model: ckc_pin.LinearModel, what: str, overrides: tuple[str, ...], out: Path) -> int:
    """Save the model and its modes in the place of those of before, whatever signals come, then draw them.

    Returns how many modes are runs.
    """
    from ckc_pin.linear.mode_animation import animate_modes

    runs = animate_modes(model)
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            for path in out.iterdir():
                if OF_MODEL.fullmatch(path.name) and path.is_file():
                    path.unlink()
            model.save(out / "linear.npz")
            for number, run in runs.items():
                run.save(out / f"mode_{number}.npz")
        locus = None
        try:
            locus = ckc_pin.gain_locus(what, overrides=read_overrides("--set", overrides))
        except CkcError as error:
            errors().print(f"no root locus: {error}")
        try:
            from ckc_pin.view.linear_figures import save_linear_figures

            save_linear_figures(model, locus, out)
        except InputError as error:  # matplotlib is an extra; the model is saved
            errors().print(f"no figures: {error}")
    return len(runs)
