"""Options and arguments that several commands share."""

from __future__ import annotations

import math
from pathlib import Path

import click

from ckc_pin.errors import InputError

__all__ = ["as_json", "changes", "check_speed", "examples", "mechanism", "open_browser", "overwrite", "port", "runs"]

as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
changes = click.option(
    "--set",
    "changes",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a key of the scene; may be given many times.",
)
mechanism = click.argument("mechanism", metavar="MECHANISM", help="A mechanism.")
runs = click.argument(
    "runs", metavar="RUN...", type=Path, nargs=-1, required=True, help="Run files, or folders that hold a run.npz."
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace what is there already.")
port = click.option("--port", type=int, default=0, help="Port on 127.0.0.1; 0: any free one.")
open_browser = click.option("--open", "open_browser", is_flag=True, help="Open your browser too.")


def examples(*lines: str) -> str:
    """Return the end of a command's help."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def check_speed(speed: float) -> None:
    """Refuse a speed that playback cannot have."""
    if not (math.isfinite(speed) and speed > 0):
        raise InputError(f"--speed {speed:g}: it must be above zero, 1 is real time")
