"""The commands identify and calibrate: parameters from measurements."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ckc_pin.base.atomic_files import lock_folder, write_atomic
from ckc_pin.base.summary import to_json
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    Spinner,
    exit_unless_done,
    format_destination,
    make_folder,
    print_json,
    print_summary,
    skip_figures_without_matplotlib,
)
from ckc_pin.cli.signals import interrupts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ckc_pin.identification.result import Identification

__all__ = ["calibrate", "identify"]


@click.command(
    epilog=options.format_examples(
        "ckc identify swing.identify.toml",
        "ckc identify swing.identify.toml --out identified --figures",
        "ckc identify swing.identify.toml --set estimate.robust=true --json",
    )
)
@click.argument(
    "file", metavar="FILE", type=options.PATH, help="A *.identify.toml: a mechanism, recorded motions, and parameters."
)
@options.out(help="Folder for identification.json, parameters.toml and report.html.")
@options.overrides_of_file
@options.figures
@options.as_json
def identify(file: Path, overrides: dict[str, Any], out: Path | None, figures: bool, as_json: bool) -> None:
    """Estimate parameters from measurements. Coordinates and motor torques of recorded motions are needed."""
    from ckc_pin.identification.identify import identify_file

    options.require_folder(out, figures)
    if out is not None:
        make_folder(out)
    with Spinner(f"identify {file.name}"):
        result = identify_file(file, overrides)
    if out is not None:
        with ExitStack() as stack:
            with interrupts.deferred():
                stack.enter_context(lock_folder(out))
                write_atomic(out / "identification.json", to_json(result.to_dict()) + "\n")
                result.save(out / "parameters.toml")
            _write_report(result, out, figures)
    if as_json:
        print_json(result.to_dict())
    else:
        print_summary(result.summary())
        print(format_destination(out, "identification.json, parameters.toml and report.html"))


@click.command(
    epilog=options.format_examples(
        "ckc calibrate arm.calibrate.toml",
        "ckc calibrate arm.calibrate.toml --out calibrated",
        "ckc calibrate arm.calibrate.toml --set estimate.loss=huber --json",
    )
)
@click.argument(
    "file",
    metavar="FILE",
    type=options.PATH,
    help="A *.calibrate.toml: a mechanism, readings of poses, and parameters.",
)
@options.out(help="Folder for calibration.json and parameters.toml.")
@options.overrides_of_file
@options.as_json
def calibrate(file: Path, overrides: dict[str, Any], out: Path | None, as_json: bool) -> None:
    """Calibrate lengths and encoders. Readings of more coordinates than freedoms, or of points, are needed."""
    from ckc_pin.identification.calibration import calibrate_file

    if out is not None:
        make_folder(out)
    with Spinner(f"calibrate {file.name}"):
        result = calibrate_file(file, overrides)
    if out is not None:
        with ExitStack() as stack, interrupts.deferred():
            stack.enter_context(lock_folder(out))
            write_atomic(out / "calibration.json", to_json(result.to_dict()) + "\n")
            result.save(out / "parameters.toml")
    if as_json:
        print_json(result.to_dict())
    else:
        print_summary(result.summary())
        print(format_destination(out, "calibration.json and parameters.toml"))
    exit_unless_done("done" if result.converged else "stopped", result.message)


def _write_report(result: Identification, out: Path, figures: bool) -> None:
    """Write report.html, and the figures as files."""
    from ckc_pin.view.identification_figures import draw_identification
    from ckc_pin.view.layout import write_figure
    from ckc_pin.view.report_page import render_report

    drawn: dict[str, Figure] = {}
    with skip_figures_without_matplotlib():
        drawn = draw_identification(result)
    write_atomic(out / "report.html", render_report(result, drawn))
    for name, figure in drawn.items() if figures else ():
        write_figure(figure, out, name, ("png",))
