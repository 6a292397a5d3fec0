"""Options and arguments that several commands share: their declaration, parsing and shell completion.

The placeholder of a value says in capitals what it is: DIR, FILE, N, SECONDS. The values of a choice are listed,
[joint|cartesian].
"""

from __future__ import annotations

import json
import math
import sys
import tomllib
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

__all__ = ["PATH", "as_json", "complete_scenes", "csv", "figures", "format_examples", "mechanism", "open_browser",
           "out", "overrides", "overrides_of_file",
           "overwrite", "port", "read_overrides", "read_table", "require_folder", "require_speed",
           "runs"]  # fmt: skip

MAX_QUOTED = 80  # characters of a user's text in a message


class _Path(click.Path):
    """A path. An empty one is rejected: it is mostly a shell variable without a value, not the current folder."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Return the path (InputError if it is empty or invalid)."""
        from ckc_pin.base.validation import require_path

        if parameter is not None:
            name = str(parameter.opts[0] if isinstance(parameter, click.Option) else parameter.metavar)
            if value == "":
                raise InputError(f"{name} is empty; give a name")
            require_path(value, name, "the name of a file or folder")
        return super().convert(value, parameter, context)


PATH = _Path(path_type=Path)


# --- completion ----------------------------------------------------------------------------------


def complete_mechanisms(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of a shipped mechanism, or a path."""
    from ckc_pin.mechanism.library import shipped

    return _complete(shipped(), incomplete)


def complete_scenes(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of a shipped mechanism or scene, or a path."""
    from ckc_pin.mechanism.library import shipped
    from ckc_pin.scene.names import list_scene_names

    names = []
    for mechanism_name in shipped():
        names += [mechanism_name, *(f"{mechanism_name}/{scene}" for scene in list_scene_names(mechanism_name))]
    return _complete(names, incomplete)


def _complete(names: list[str], incomplete: str) -> list[CompletionItem]:
    from click.shell_completion import CompletionItem

    matches = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    return [*matches, CompletionItem(incomplete, type="file")]


# --- declarations --------------------------------------------------------------------------------

as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
mechanism = click.argument(
    "mechanism", metavar="MECHANISM", shell_complete=complete_mechanisms, help="A shipped name, a folder or a file."
)
runs = click.argument(
    "runs",
    metavar="RUN...",
    type=PATH,
    nargs=-1,
    required=True,
    help="Run files, or folders that contain a run.npz.",
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace existing files.")
figures = click.option("--figures", is_flag=True, help="With --out: also draw figures there.")
out = partial(click.option, "--out", metavar="DIR", type=PATH)
csv = partial(click.option, "--csv", metavar="FILE", type=PATH)
port = click.option("--port", metavar="PORT", type=int, default=0, help="Port on 127.0.0.1; 0: any free one.")
open_browser = click.option("--open", "open_browser", is_flag=True, help="Also open the default browser.")


def overrides(command: Callable[..., Any], file: str = "scene") -> Callable[..., Any]:
    """Add the options --set and --unset to a command, which gets both as one table `overrides`; None removes a key."""

    @click.option(
        "--set",
        "settings",
        metavar="KEY=VALUE",
        multiple=True,
        help=f"Override a key of the {file} or a parameter of the mechanism. May be repeated.",
    )
    @click.option(
        "--unset", "removed", metavar="KEY", multiple=True, help=f"Remove a key of the {file}. May be repeated."
    )
    @wraps(command)
    def with_overrides(*args: Any, settings: tuple[str, ...], removed: tuple[str, ...], **options: Any) -> Any:
        values = read_overrides("--set", settings)
        for key in removed:
            if key in values:
                raise InputError(f"--unset {key}: --set gives it a value; leave one of them out")
            if "=" in key or not all(part.strip() for part in key.split(".")):
                raise InputError(f"--unset {key}: write KEY, e.g. controller.torque_limit")
        return command(*args, overrides=values | dict.fromkeys(removed), **options)

    return with_overrides


overrides_of_file = partial(overrides, file="file")


def format_examples(*lines: str) -> str:
    """Return the section of examples at the end of a command's help."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


# --- values --------------------------------------------------------------------------------------


def require_speed(speed: float) -> None:
    """Raise InputError if a playback speed is not a positive number."""
    if not (math.isfinite(speed) and speed > 0):
        raise InputError(f"--speed {speed:g}: it must be above zero, 1 is real time")


def require_folder(out: Path | None, figures: bool) -> None:
    """Raise InputError if figures are requested without a folder to write them to."""
    if figures and out is None:
        raise InputError("--figures goes with --out DIR; give both")


def read_overrides(option: str, settings: Iterable[str]) -> dict[str, Any]:
    """Parse settings KEY=VALUE. A value is TOML if possible, else a plain string.

    Raises
    ------
    InputError
        A setting has no `=`, or its key has an empty part.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not all(part.strip() for part in key.split(".")):
            raise InputError(f"{option} {setting}: write KEY=VALUE, e.g. solver.rtol=1e-10")
        values[key.strip()] = _parse_value(text)
    return values


def _parse_value(text: str) -> Any:
    """Parse TOML, or a number that is not valid TOML (.1, 5., 1.e-3); otherwise return the text itself."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        pass
    with suppress(ValueError):
        if any(character.isdigit() for character in text):  # "Infinity" and "NaN" remain strings.
            return float(text)
    return text


def read_table(option: str, text: str) -> dict[str, float]:
    """Parse a JSON table of numbers by coordinate.

    Raises
    ------
    InputError
        The text is not JSON or not a table, a name occurs twice, or a value is not a finite number.
    """
    example = f"write a table by coordinate, e.g. {option} '{{\"theta_1\": 0.4}}'"
    repeated: list[str] = []

    def collect(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        repeated.extend(name for k, name in enumerate(names) if name in names[:k])
        return dict(pairs)

    try:
        table = json.loads(text, object_pairs_hook=collect)
    except (ValueError, RecursionError):
        raise InputError(f"{option} {text[:MAX_QUOTED]}: not JSON; {example}") from None
    if not isinstance(table, dict):
        raise InputError(f"{option} {text[:MAX_QUOTED]}: not a table; {example}")
    if repeated:
        raise InputError(f"{option}: {repeated[0]} is given twice; give each coordinate once")
    for name, value in table.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not abs(value) <= sys.float_info.max:
            raise InputError(f"{option}: {name} = {json.dumps(value)[:MAX_QUOTED]}: expected a finite number")
    return table
