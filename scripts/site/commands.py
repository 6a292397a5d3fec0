"""Generate the reference of the commands with their arguments and options from click."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import cleandoc

import click

from ckc_pin.cli.app import COMMANDS, ckc

__all__ = ["markdown", "undocumented"]


def markdown() -> str:
    """Return a section for each command, in MyST."""
    return "\n".join(line for name in COMMANDS for line in _command(name))


def undocumented() -> list[str]:
    """Return commands, options and arguments without a help text."""
    missing = []
    for name in COMMANDS:
        command, context = _click(name)
        missing += [f"ckc {name}"] if not command.help else []
        for parameter in command.get_params(context):
            if not getattr(parameter, "help", None):
                missing.append(f"ckc {name} {parameter.human_readable_name}")
    return missing


def _click(name: str) -> tuple[click.Command, click.Context]:
    command = ckc.get_command(click.Context(ckc), name)
    assert command is not None
    return command, click.Context(command, info_name=f"ckc {name}")


def _command(name: str) -> Iterator[str]:
    command, context = _click(name)
    yield f"(command-{name})=\n## `ckc {name}`\n"
    yield f"```text\n{command.get_usage(context).removeprefix('Usage: ')}\n```\n"
    for part in cleandoc(command.help or "").split("\n\n"):
        if part.startswith("\b\n"):
            yield "```text\n" + part.removeprefix("\b\n") + "\n```\n"
        else:
            yield _text(part) + "\n"
    rows = [
        record for record in (parameter.get_help_record(context) for parameter in command.get_params(context)) if record
    ]
    if rows:
        yield from ("| option | meaning |", "|---|---|")
        yield from (f"| `{left.replace('|', chr(92) + '|')}` | {_text(right)} |" for left, right in rows)
        yield ""
    if command.epilog:
        lines = [
            line.strip() for line in command.epilog.replace("\b", "").splitlines() if line.strip().startswith("ckc")
        ]
        yield "```sh\n" + "\n".join(lines) + "\n```\n"


def _text(text: str) -> str:
    """Escape characters that Markdown would interpret, and join the lines."""
    for sign in "*_<[|":
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split())
