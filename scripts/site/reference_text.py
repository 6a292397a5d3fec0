"""Write the reference of keys, commands, public names and messages as text: `python -m scripts.site.reference_text`.

The files in docs/reference/text are committed, so that the reference can be read without building the site.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from textwrap import indent

import click

import ckc_pin
from ckc_pin.cli.app import COMMANDS, ckc
from ckc_pin.cli.key_tables import FILES, format_tables, tables
from scripts.site import protocol
from scripts.site.api import members_of, names
from scripts.site.protocol import DIRECTIONS

__all__ = ["FOLDER", "texts", "write"]

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference" / "text"
WIDTH = 100  # of the help of commands


def texts() -> dict[str, str]:
    """Return the content of each file by its name."""
    lines = {"keys.txt": _keys(), "commands.txt": _commands(), "api.txt": _api(), "explorer_protocol.txt": _protocol()}
    return {name: "\n".join(line.rstrip() for line in of_file).rstrip() + "\n" for name, of_file in lines.items()}


def write() -> None:
    """Write all files."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in texts().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


def _keys() -> Iterator[str]:
    yield "Keys of all files that a user writes, as `ckc keys` prints them."
    yield ""
    yield from format_tables([(file, table) for file in FILES for table in tables(file)])


def _commands() -> Iterator[str]:
    yield "Commands, as `ckc COMMAND --help` prints them."
    for name in COMMANDS:
        command = ckc.get_command(click.Context(ckc), name)
        assert command is not None
        context = click.Context(command, info_name=f"ckc {name}", terminal_width=WIDTH, max_content_width=WIDTH)
        context.help_option_names = ["-h", "--help"]
        yield from ("", "=" * WIDTH, f"ckc {name}", "=" * WIDTH, *command.get_help(context).splitlines())


def _api() -> Iterator[str]:
    yield "Public names of ckc_pin with their docstrings."
    for kind, members in names().items():
        yield from ("", "=" * WIDTH, kind, "=" * WIDTH)
        for name in members:
            value = getattr(ckc_pin, name)
            signature = str(inspect.signature(value)) if kind == "Functions" else ""
            yield from ("", f"ckc_pin.{name}{signature}", "", indent(inspect.getdoc(value) or "", "    "))
            for member, of in members_of(value):
                first = (inspect.getdoc(of) or "").partition("\n\n")[0].replace("\n", " ")
                parentheses = "()" if callable(of) or isinstance(of, classmethod) else ""
                yield f"\n    .{member}{parentheses}: {first}"


def _protocol() -> Iterator[str]:
    yield "Messages between the explorer's page and the program."
    for direction in DIRECTIONS:
        yield from ("", f"## {direction}", "", protocol.markdown(direction))


if __name__ == "__main__":
    write()
