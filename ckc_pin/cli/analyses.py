"""Commands that analyse a mechanism or a motion: inverse, linearize, sensitivities, map."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    ProgressBar,
    Spinner,
    error_console,
    exit_unless_done,
    format_destination,
    make_folder,
    print_json,
    print_summary,
    print_table,
    require_file_path,
    skip_figures_without_matplotlib,
    write_csv,
)
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import CkcError, InputError

if TYPE_CHECKING:
    from ckc_pin.linear.linearize import At

__all__ = ["inverse", "linearize", "map_", "sensitivities"]

MODEL_FILES = re.compile(r"mode_\d+\.npz|(poles|modes|locus)\.png")  # of an earlier model; not all are written again


# --- inverse -------------------------------------------------------------------------------------


@click.command(
    epilog=options.format_examples(
        "ckc inverse five_bar/tracking --out forces --figures",
        "ckc inverse five_bar/tracking --csv forces.csv",
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
@options.csv(help="Also write motion and forces as a CSV file, a row for each instant; columns are named quantities.")
@options.as_json
def inverse(
    what: str, overrides: dict[str, Any], out: Path | None, figures: bool, csv: Path | None, as_json: bool
) -> None:
    """Compute motor, loop and joint forces along a motion. It is a scene's desired motion, or that of a run."""
    options.require_folder(out, figures)
    if out is not None:
        make_folder(out)
    require_file_path(csv, "--csv")
    with ProgressBar(what) as progress:
        forces = ckc_pin.inverse_dynamics(what, overrides, progress=progress)
    if out is not None:
        _save_forces(forces, out, figures)
    if as_json:
        print_json(forces.to_dict())
    else:
        print_summary(forces.summary())
        print(format_destination(out, "inverse.npz, for other programs"))
    write_csv(forces, csv, as_json)
    exit_unless_done(forces.status, forces.message)


def _save_forces(forces: ckc_pin.MotionForces, out: Path, figures: bool) -> None:
    """Save the forces while signals are deferred, then draw them if requested."""
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            forces.save(out / "inverse.npz")
        if figures:
            from ckc_pin.view.result_figures import save_motion_forces

            with skip_figures_without_matplotlib():
                save_motion_forces(forces, out)


# --- linearize -----------------------------------------------------------------------------------


@click.command(
    epilog=options.format_examples(
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
    help="Operating point: the stable equilibrium (default), a time of the scene's run in s, or a pose that the motors "
    "hold: as assembled, the target of a set point, or a table of coordinates.",
)
@click.option(
    "--period",
    metavar="SECONDS",
    type=float,
    help="Linearize along the scene's periodic motion instead: monodromy matrix, Floquet multipliers.",
)
@options.overrides
@click.option(
    "--out",
    metavar="DIR",
    type=options.PATH,
    help="Folder for linear.npz, figures, and the modes as runs to play; with --period for floquet.npz and run.npz.",
)
@options.csv(help="Also write A, B, C and D as a CSV file with the names of states, inputs and outputs.")
@options.as_json
def linearize(
    what: str,
    at: str | None,
    period: float | None,
    overrides: dict[str, Any],
    out: Path | None,
    csv: Path | None,
    as_json: bool,
) -> None:
    """Compute A, B, C, D and modes in minimal coordinates. The model is exact, about rest or along a run."""
    if at is not None and period is not None:
        raise InputError(
            "--at and --period are both given; give --at for a model at one state, or --period for a periodic motion"
        )
    if csv is not None and period is not None:
        raise InputError("--csv and --period are both given; a periodic motion has no A, B, C and D")
    if out is not None:
        make_folder(out)
    require_file_path(csv, "--csv")
    if period is not None:
        with ProgressBar(what) as progress:
            orbit = ckc_pin.floquet(what, period, overrides, progress)
        if out is not None:
            _save_floquet(orbit, out)
        _print_model(orbit, out, as_json)
        return
    with Spinner(f"linearizing {what}"):
        model = ckc_pin.linearize(what, _parse_operating_point("equilibrium" if at is None else at), overrides)
    playable, modes = 0 if out is None else _save_model(model, what, overrides, out), len(model.modes)
    reasons = "rigid modes, modes that the loops do not follow, and modes beyond the twelfth are left out"
    note = "" if playable == modes else f"; {playable} of {modes} modes can be played: {reasons}"
    _print_model(model, out, as_json, note)
    write_csv(model, csv, as_json)


def _print_model(
    result: ckc_pin.LinearModel | ckc_pin.Floquet, out: Path | None, as_json: bool, note: str = ""
) -> None:
    if as_json:
        print_json(result.to_dict())
        return
    print_summary(result.summary())
    if out is not None:
        print(f"written to {out}{note}")


def _parse_operating_point(text: str) -> At:
    if text in ("equilibrium", "assembled", "target"):
        return text
    if text.lstrip().startswith("{"):
        return options.read_table("--at", text)
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--at {text!r:.80}: give equilibrium, assembled, target, a time in seconds, or a table of coordinates as "
            "JSON"
        ) from None


def _save_floquet(orbit: ckc_pin.Floquet, out: Path) -> None:
    with interrupts.deferred(), ExitStack() as stack:
        stack.enter_context(lock_folder(out))
        orbit.save(out / "floquet.npz")
        orbit.run.save(out / "run.npz")


def _save_model(model: ckc_pin.LinearModel, what: str, overrides: dict[str, Any], out: Path) -> int:
    """Replace the files of an earlier model while signals are deferred, then draw figures.

    Returns the number of modes that were saved as runs.
    """
    from ckc_pin.linear.mode_animation import animate_modes
    from ckc_pin.view.linear_figures import save_linear_figures

    runs = animate_modes(model)
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            for path in out.iterdir():
                if MODEL_FILES.fullmatch(path.name) and path.is_file():
                    path.unlink()
            model.save(out / "linear.npz")
            for number, run in runs.items():
                run.save(out / f"mode_{number}.npz")
        locus = None
        try:
            locus = ckc_pin.gain_locus(what, overrides=overrides)
        except CkcError as error:
            error_console().print(f"no root locus: {error}")
        with skip_figures_without_matplotlib():
            save_linear_figures(model, locus, out)
    return len(runs)


# --- sensitivities -------------------------------------------------------------------------------


@click.command(
    epilog=options.format_examples(
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
    help="Parameters of the mechanism, the controller or the initial state, e.g. link.rod.mass or initial.q.crank.",
)
@options.overrides
@options.out(help="Folder for sensitivities.npz and run.npz.")
@options.figures
@options.csv(help="Also write the derivatives as a CSV file, a row for each output instant.")
@options.as_json
def sensitivities(
    scene: str,
    parameters: tuple[str, ...],
    overrides: dict[str, Any],
    out: Path | None,
    figures: bool,
    csv: Path | None,
    as_json: bool,
) -> None:
    """Compute parameter derivatives of a run. They are exact, also through impacts and sticking."""
    options.require_folder(out, figures)
    if out is not None:
        make_folder(out)
    require_file_path(csv, "--csv")
    with ProgressBar(scene) as progress:
        result = ckc_pin.sensitivities(scene, parameters, overrides, progress)
    if out is not None:
        _save_sensitivities(result, out, figures)
    if as_json:
        print_json(result.to_dict())
    else:
        print_summary(result.summary())
        print(format_destination(out, "sensitivities.npz, for other programs"))
    write_csv(result, csv, as_json)
    exit_unless_done(result.run.status, result.run.message)


def _save_sensitivities(result: ckc_pin.Sensitivities, out: Path, figures: bool) -> None:
    """Save sensitivities and run while signals are deferred, then draw them if requested."""
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            result.save(out / "sensitivities.npz")
            result.run.save(out / "run.npz")
        if figures:
            with skip_figures_without_matplotlib():
                ckc_pin.plot(result).save(out)


# --- map -----------------------------------------------------------------------------------------


@click.command(
    "map",
    epilog=options.format_examples(
        "ckc map five_bar --scene tracking --out figures",
        "ckc map five_bar --space cartesian --out figures",
        "ckc map delta --space cartesian --over x,z --out figures",
        "ckc map delta --space cartesian --sections 6 --out figures",
    ),
)
@options.mechanism
@click.option(
    "--scene",
    metavar="SCENE",
    shell_complete=options.complete_scenes,
    help="Also draw the desired trajectory of this scene and measure how near it comes to singular configurations.",
)
@click.option("--over", metavar="A,B", help="Coordinates of the axes; the others are fixed.")
@click.option(
    "--space",
    type=click.Choice(["joint", "cartesian"]),
    default="joint",
    help="cartesian: over the position of a point.",
)
@click.option("--point", metavar="POINT", help="A [[point]]; default: the first one.")
@click.option("--cells", metavar="N", type=int, default=200, help="Cells along each axis.")
@click.option("--sections", metavar="N", type=int, help="For three freedoms: N sections at different heights.")
@options.out(help="Folder for the figure.")
@options.csv(help="Also write the map as a CSV file, a row for each cell that is reached.")
@options.as_json
def map_(
    mechanism: str,
    scene: str | None,
    over: str | None,
    space: str,
    point: str | None,
    cells: int,
    sections: int | None,
    out: Path | None,
    csv: Path | None,
    as_json: bool,
) -> None:
    """Map reachable and singular configurations. There is one map for each branch, as in the paper's Fig. 2."""
    from ckc_pin.analysis import map as maps
    from ckc_pin.view.map_figures import require_matplotlib, save_map, save_sections

    if out is not None:
        make_folder(out)
        require_matplotlib()
    require_file_path(csv, "--csv")
    if csv is not None and sections is not None:
        raise InputError("--csv and --sections are both given; write one section, without --sections")
    if sections is not None and (space != "cartesian" or scene is not None):
        raise InputError("--sections goes with --space cartesian, and without --scene")
    axes = None if over is None else [name.strip() for name in over.split(",")]
    with ProgressBar.percentage(f"map of {mechanism}") as bar:

        def report_progress(fraction: float) -> None:
            bar(fraction, 1.0)

        if sections is None:
            single = ckc_pin.singularity_map(
                mechanism, scene=scene, space=space, over=axes, point=point, cells=cells, progress=report_progress
            )
        else:
            stack = maps.workspace_sections(
                mechanism, point=point, over=axes or ("x", "y"), count=sections, cells=cells, progress=report_progress
            )
    if as_json:
        print_json(single.to_dict() if sections is None else maps.sections_to_dict(stack))
    else:
        print_table(maps.make_map_table(single) if sections is None else maps.make_sections_table(stack))
    if out is None and not as_json:
        print("not drawn: --out DIR draws the map there")
    elif out is not None:
        for path in save_map(single, out) if sections is None else save_sections(stack, out):
            (error_console().print if as_json else print)(f"written: {path}")
    if sections is None:
        write_csv(single, csv, as_json)
