"""The command report: error against run time for scenes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder, write_atomic
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    LONG_S,
    ProgressBar,
    error_console,
    exit_unless_done,
    format_destination,
    is_terminal,
    make_folder,
    print_json,
    print_table,
    print_written,
    skip_figures_without_matplotlib,
)
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError
from ckc_pin.run.prepare import prepare

if TYPE_CHECKING:
    from ckc_pin.analysis.precision import WorkPrecision

__all__ = ["report"]

MAX_FILE_NAME = 60  # characters of a scene's name in a file name


@click.command(
    epilog=options.format_examples(
        "ckc report five_bar/swing",
        "ckc report mine/drop.scene.toml --out reports/drop --budget 60",
        "ckc report five_bar/swing five_bar/tracking --json",
    )
)
@click.argument(
    "scenes",
    metavar="SCENE...",
    nargs=-1,
    required=True,
    shell_complete=options.complete_scenes,
    help="Scenes, or mechanisms for their default scenes.",
)
@options.overrides
@click.option("--budget", metavar="SECONDS", type=float, default=20.0, help="Time limit for each scene.")
@options.out(help="Folder for report.md, rows.csv and the figures.")
@options.as_json
def report(scenes: tuple[str, ...], overrides: dict[str, Any], budget: float, out: Path | None, as_json: bool) -> None:
    """Measure error against run time of scenes. Compares formulations, methods, tolerances, and recommends settings."""
    if not 0 < budget < float("inf"):
        raise InputError(f"--budget {budget:g}: expected a number of seconds above zero")
    loaded = [ckc_pin.load_scene(name, overrides) for name in scenes]
    mechanisms = [prepare(scene).mechanism for scene in loaded]  # Invalid scenes are reported before the first run.
    if out is not None:
        make_folder(out)
    if budget * len(loaded) > LONG_S:
        each = f", {budget:g} s for each of {len(loaded)} scenes" if len(loaded) > 1 else ""
        error_console().print(f"this may take {budget * len(loaded):g} s{each}; --budget SECONDS changes that")
    results: list[WorkPrecision] = []
    for scene, mechanism in zip(loaded, mechanisms, strict=True):
        results.append(_measure(scene, mechanism, budget))
        if not as_json:
            _print_result(results[-1])
        if results[-1].status == "interrupted":
            break
    paths = [] if out is None else _save_report(results, out)
    status, message = _combine_status(results)
    if as_json:
        written = [str(path) for path in paths]
        scene_dicts = [result.to_dict() for result in results]
        print_json({"status": status, "message": message, "scenes": scene_dicts, "written": written})
    else:
        print_written(paths)
        if out is None:
            print(format_destination(None, "report.md, rows.csv and figures"))
    exit_unless_done(status, message)


def _measure(scene: ckc_pin.Scene, mechanism: ckc_pin.Mechanism, budget: float) -> WorkPrecision:
    from ckc_pin.analysis.precision import work_precision

    mjcf, notes = _export_to_mjcf(mechanism)
    with ProgressBar.percentage(scene.name) as bar:

        def report_progress(fraction: float) -> None:
            bar(fraction, 1.0)

        # Without a terminal the expected duration has been printed already.
        progress = report_progress if is_terminal() else None
        result = work_precision(scene, budget=budget, mjcf=mjcf, progress=progress)
    if not mjcf or any(row.program == "MuJoCo" for row in result.rows):
        result.notes += notes
    return result


def _combine_status(results: Sequence[WorkPrecision]) -> tuple[str, str]:
    """Return the status and message of all scenes together; only the last one can be interrupted."""
    last = results[-1]
    if last.status == "interrupted":
        return last.status, last.message
    stopped = [result for result in results if result.status == "stopped"]
    message = "; ".join(f"{result.scene}: {result.message}" for result in stopped)
    return ("stopped" if stopped else "done"), message


def _print_result(result: WorkPrecision) -> None:
    from ckc_pin.analysis.precision import make_time_table

    print(f"{result.scene}: {result.message or f'{len(result.rows)} settings in {result.seconds:.1f} s'}")
    if result.reference is not None:
        print_table(make_time_table(result))
    for line in result.describe():
        print(line)


def _export_to_mjcf(mechanism: ckc_pin.Mechanism) -> tuple[str, list[str]]:
    """Return the mechanism as MJCF and how its motion differs there; or an empty text and why MuJoCo is left out."""
    from ckc_pin.formats import exporting

    if find_spec("mujoco") is None:
        return "", ["MuJoCo is not compared: not installed (pip install 'ckc_pin[peers]')"]
    try:
        exported = exporting.export(mechanism, "mjcf")
    except InputError as error:
        return "", [f"MuJoCo is not compared: {error}"]
    return exported.text, exported.differences


def _save_report(results: Sequence[WorkPrecision], out: Path) -> list[Path]:
    """Write page and rows while signals are deferred; then draw figures, and write the page with them."""
    from ckc_pin.view.result_figures import save_precision

    paths, figures = list[Path](), dict[int, str]()
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            _write_texts(results, figures, out)
        for k, result in enumerate(results):
            if result.reference is None:
                continue
            stem = "work_precision" if len(results) == 1 else f"work_precision_{k + 1}_{_to_file_name(result.scene)}"
            with skip_figures_without_matplotlib():
                paths += save_precision(result.to_dict(), out, stem)
                figures[k] = f"{stem}.png"
        return [*_write_texts(results, figures, out), *paths]


def _write_texts(results: Sequence[WorkPrecision], figures: dict[int, str], out: Path) -> list[Path]:
    from ckc_pin.analysis.precision import make_csv, make_markdown

    texts = {"rows.csv": make_csv(results), "report.md": make_markdown(results, figures)}
    for name, text in texts.items():
        write_atomic(out / name, text)
    return [out / name for name in texts]


def _to_file_name(scene: str) -> str:
    return re.sub(r"[^\w.-]+", "_", scene.removesuffix(".scene.toml")).strip("_.")[-MAX_FILE_NAME:]
