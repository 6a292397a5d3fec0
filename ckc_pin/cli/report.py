"""Work against precision of scenes of one's own: report."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

import ckc_pin
from ckc_pin.base.atomic_files import lock_folder, write_atomic
from ckc_pin.cli import options
from ckc_pin.cli.arguments import read_overrides
from ckc_pin.cli.exits import STOPPED, interrupted
from ckc_pin.cli.output import LONG, ProgressBar, errors, kept, make_folder, on_terminal, print_json, print_table
from ckc_pin.cli.signals import interrupts
from ckc_pin.errors import InputError
from ckc_pin.run.prepare import prepare

if TYPE_CHECKING:
    from ckc_pin.analysis.precision import WorkPrecision

__all__ = ["report"]


@click.command(
    epilog=options.examples(
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
@click.option("--budget", metavar="SECONDS", type=float, default=20.0, help="What each scene may take.")
@options.out(help="Folder for report.md, rows.csv and the figures.")
@options.as_json
def report(scenes: tuple[str, ...], overrides: tuple[str, ...], budget: float, out: Path | None, as_json: bool) -> None:
    """Error against run time of your own scenes. Formulations, methods and tolerances, and which of them to take."""
    from ckc_pin.analysis.precision import work_precision

    if not 0 < budget < float("inf"):
        raise InputError(f"--budget {budget:g}: expected a number of seconds above zero")
    loaded = [ckc_pin.load_scene(name, read_overrides("--set", overrides)) for name in scenes]
    mechanisms = [prepare(scene).mechanism for scene in loaded]  # what is wrong with one is told before the first
    if out is not None:
        make_folder(out)
    if budget * len(loaded) > LONG:
        many = f", {budget:g} s for each of {len(loaded)} scenes" if len(loaded) > 1 else ""
        errors().print(f"this may take {budget * len(loaded):g} s{many}; --budget SECONDS changes that")
    every: list[WorkPrecision] = []
    for scene, mechanism in zip(loaded, mechanisms, strict=True):
        mjcf, note = _mjcf(mechanism)
        with ProgressBar(scene.name, "{task.percentage:.0f} %") as bar:
            progress = partial(_part, bar) if on_terminal() else None  # how long it takes was said
            found = work_precision(scene, budget=budget, mjcf=mjcf, progress=progress)
        if not mjcf or any(row.program == "MuJoCo" for row in found.rows):
            found.notes += note
        every.append(found)
        if not as_json:
            _print(found)
        if found.status == "interrupted":
            break
    plain = [found.to_dict() for found in every]
    last = every[-1]
    stopped = [found for found in every if found.status == "stopped"]
    status = last.status if last.status == "interrupted" else "stopped" if stopped else "done"
    message = last.message if last.status == "interrupted" else "; ".join(f"{x.scene}: {x.message}" for x in stopped)
    written = [] if out is None else _write(every, plain, out)
    if as_json:
        print_json({"status": status, "message": message, "scenes": plain, "written": [str(path) for path in written]})
    else:
        for path in written:
            print(f"written: {path}")
        if out is None:
            print(kept(None, "report.md, rows.csv and figures"))
    if status != "done":
        errors().print(message)
        raise click.exceptions.Exit(STOPPED if status == "stopped" else interrupted(message))


def _part(bar: Callable[[float, float], None], part: float) -> None:
    bar(part, 1.0)


def _print(found: WorkPrecision) -> None:
    from ckc_pin.analysis.precision import make_time_table

    print(f"{found.scene}: {found.message or f'{len(found.rows)} settings in {found.seconds:.1f} s'}")
    if found.reference is not None:
        print_table(make_time_table(found))
    for line in found.describe():
        print(line)


def _mjcf(mechanism: ckc_pin.Mechanism) -> tuple[str, list[str]]:
    """Return the mechanism as MuJoCo's model, or why there is none, and what moves otherwise there."""
    from ckc_pin.formats import exporting

    if find_spec("mujoco") is None:
        return "", ["MuJoCo is not compared: not installed (pip install 'ckc_pin[peers]')"]
    try:
        found = exporting.export(mechanism, "mjcf")
    except InputError as error:
        return "", [f"MuJoCo is not compared: {error}"]
    return found.text, found.differences


def _write(every: Sequence[WorkPrecision], plain: Sequence[dict[str, object]], out: Path) -> list[Path]:
    """Write page and rows, whatever signals come; then draw figures, and write the page with them."""
    written, figures = list[Path](), dict[int, str]()
    with ExitStack() as stack:
        with interrupts.deferred():
            stack.enter_context(lock_folder(out))
            _write_texts(every, figures, out)
        for k, (found, data) in enumerate(zip(every, plain, strict=True)):
            if found.reference is None:
                continue
            stem = "work_precision" if len(every) == 1 else f"work_precision_{k + 1}_{_as_file(found.scene)}"
            try:
                from ckc_pin.view.result_figures import save_precision

                written += save_precision(data, out, stem)
                figures[k] = f"{stem}.png"
            except InputError as error:  # matplotlib is an extra
                errors().print(f"no figure: {error}")
        return [*_write_texts(every, figures, out), *written]


def _write_texts(every: Sequence[WorkPrecision], figures: dict[int, str], out: Path) -> list[Path]:
    from ckc_pin.analysis.precision import make_csv, make_markdown

    texts = {"rows.csv": make_csv(every), "report.md": make_markdown(every, figures)}
    for name, text in texts.items():
        write_atomic(out / name, text)
    return [out / name for name in texts]


def _as_file(scene: str) -> str:
    return re.sub(r"[^\w.-]+", "_", scene.removesuffix(".scene.toml")).strip("_.")[-60:]
