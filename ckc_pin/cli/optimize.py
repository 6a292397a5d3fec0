"""The command optimize: planned motions."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from ckc_pin.base.atomic_files import lock_folder
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    Spinner,
    format_destination,
    make_folder,
    print_json,
    print_summary,
    skip_figures_without_matplotlib,
)
from ckc_pin.cli.signals import interrupts

__all__ = ["optimize"]


@click.command(
    epilog=options.format_examples(
        "ckc optimize swing.optimize.toml",
        "ckc optimize swing.optimize.toml --out plan",
        "ckc optimize swing.optimize.toml --set limits.torque=3.0 --set link.plate.mass=0.2",
        "ckc optimize swing.optimize.toml --json",
    )
)
@click.argument(
    "file", metavar="FILE", type=options.PATH, help="A *.optimize.toml: a mechanism, a path or a target, and limits."
)
@options.overrides_of_file
@options.out(help="Folder for open.scene.toml, closed.scene.toml, plan.csv, plan.json and the figure.")
@options.as_json
def optimize(file: Path, overrides: dict[str, Any], out: Path | None, as_json: bool) -> None:
    """Plan the motion that a file describes. The plan is replayed in the step loop."""
    from ckc_pin.optimization.optimize import optimize_file

    if out is not None:
        make_folder(out)
    with Spinner(f"optimize {file.name}"):
        plan = optimize_file(file, overrides)
    files: list[Path] = []
    if out is not None:
        with ExitStack() as stack:
            with interrupts.deferred():
                stack.enter_context(lock_folder(out))
                files = plan.save(out, overwrite=True)
            with skip_figures_without_matplotlib():
                files += plan.plot().save(out)
    if as_json:
        print_json(plan.to_dict(files))
    else:
        print_summary(plan.summary())
        scenes = "open.scene.toml and closed.scene.toml" if plan.can_be_tracked else "open.scene.toml"
        if plan.sections:
            scenes = f"{scenes} in part_1 to part_{len(plan.sections)}"
        print(format_destination(out, f"{scenes}, to run, and plan.csv, for the robot"))
