"""The command that prints the reference of keys."""

from __future__ import annotations

import click

from ckc_pin.cli import options
from ckc_pin.cli.output import print_json

__all__ = ["keys"]


@click.command(
    epilog=options.format_examples("ckc keys motor", "ckc keys scene.solver", "ckc keys set_point", "ckc keys | less")
)
@click.argument(
    "table",
    metavar="[TABLE]",
    required=False,
    help="A table, as motor, solver, controller.desired or tracking; or all tables of a file: mechanism, scene, sweep.",
)
@options.as_json
def keys(table: str | None, as_json: bool) -> None:
    """Print the keys of mechanism, scene and sweep files.

    A line for each key says its type, its unit, its default and its meaning.
    """
    from ckc_pin.cli.key_tables import FILES, find_tables, format_tables, tables

    selected = [(file, each) for file in FILES for each in tables(file)] if table is None else find_tables(table)
    if as_json:
        print_json({"tables": [each.to_dict() | {"file": file} for file, each in selected]})
        return
    for line in format_tables(selected):
        print(line)
