"""Options and arguments that several commands share, what stands for their values, and how a shell completes them.

A value's name says what it is, in capitals: DIR, FILE, N, SECONDS; a choice of few is written out, [joint|cartesian].
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

__all__ = [
    "PATH",
    "as_json",
    "check_speed",
    "complete_scenes",
    "examples",
    "figures",
    "mechanism",
    "open_browser",
    "out",
    "overrides",
    "overwrite",
    "port",
    "require_folder",
    "runs",
]  # fmt: skip


class _Path(click.Path):
    """A path; an empty one, as of a variable that is not set, is none, and not the folder where one is."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Return the path (InputError where it is empty or not valid)."""
        from ckc_pin.base.validation import require_path

        if parameter is not None:
            name = str(parameter.opts[0] if isinstance(parameter, click.Option) else parameter.metavar)
            if value == "":
                raise InputError(f"{name} is empty; give a name")
            require_path(value, name, "the name of a file or folder")
        return super().convert(value, parameter, context)


PATH = _Path(path_type=Path)


def complete_mechanisms(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a shipped mechanism's name, or a path."""
    from ckc_pin.mechanism.library import shipped

    return _completed(shipped(), incomplete)


def complete_scenes(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a shipped mechanism's or scene's name, or a path."""
    from ckc_pin.mechanism.library import shipped
    from ckc_pin.scene.scene import list_scene_names

    return _completed([name for one in shipped() for name in (one, *_of(one, list_scene_names(one)))], incomplete)


def _of(mechanism: str, scenes: list[str]) -> list[str]:
    return [f"{mechanism}/{scene}" for scene in scenes]


def _completed(names: list[str], incomplete: str) -> list[CompletionItem]:
    from click.shell_completion import CompletionItem

    found = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    return [*found, CompletionItem(incomplete, type="file")]


as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
overrides = click.option(
    "--set",
    "overrides",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a key of the scene, or a number of the mechanism; may be given many times.",
)
mechanism = click.argument(
    "mechanism", metavar="MECHANISM", shell_complete=complete_mechanisms, help="A shipped name, a folder or a file."
)
runs = click.argument(
    "runs",
    metavar="RUN...",
    type=PATH,
    nargs=-1,
    required=True,
    help="Run files, or folders that hold a run.npz.",
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace what is there already.")
figures = click.option("--figures", is_flag=True, help="With --out: draw figures there too.")
out = partial(click.option, "--out", metavar="DIR", type=PATH)
port = click.option("--port", metavar="PORT", type=int, default=0, help="Of 127.0.0.1; 0: any free one.")
open_browser = click.option("--open", "open_browser", is_flag=True, help="Open your browser too.")


def examples(*lines: str) -> str:
    """Return the end of a command's help."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def check_speed(speed: float) -> None:
    """Refuse a speed that playback cannot have."""
    if not (math.isfinite(speed) and speed > 0):
        raise InputError(f"--speed {speed:g}: it must be above zero, 1 is real time")


def require_folder(out: Path | None, figures: bool) -> None:
    """Refuse figures that have no place."""
    if figures and out is None:
        raise InputError("--figures goes with --out DIR; give both")
