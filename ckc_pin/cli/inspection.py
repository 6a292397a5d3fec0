"""Commands that inspect mechanisms and scenes without running them: list, check, terms; and compile."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

import ckc_pin
from ckc_pin.cli import options
from ckc_pin.cli.output import (
    LONG_S,
    Spinner,
    create_table,
    error_console,
    print_json,
    print_summary,
    print_table,
)

if TYPE_CHECKING:
    from rich.console import Group

    from ckc_pin.base.arrays import Array
    from ckc_pin.dynamics.terms import Terms

__all__ = ["check", "compile_", "keys", "list_", "terms"]


@click.command("list", epilog=options.format_examples("ckc list"))
@options.as_json
def list_(as_json: bool) -> None:
    """List shipped mechanisms and scenes."""
    from ckc_pin.scene.names import list_catalogue

    entries = list_catalogue()
    if as_json:
        print_json({"mechanisms": [{"name": n, "about": about, "scenes": scenes} for n, about, scenes in entries]})
        return
    for name, about, scenes in entries:
        print(f"{name:<22} {about}")
        for scene, description in scenes.items():
            print(f"  {name + '/' + scene:<30} {description}")


@click.command(
    epilog=options.format_examples(
        "ckc check five_bar",
        "ckc check five_bar --set link.link_2.mass=0.3",
        "ckc check five_bar_as_printed/tracking",
        "ckc check five_bar/set_point --set controller.K_P=2 --set controller.sample_time=0.005",
    )
)
@click.argument(
    "what",
    metavar="MECHANISM|SCENE",
    shell_complete=options.complete_scenes,
    help="A shipped name, a folder or a file. A folder stands for its mechanism.",
)
@options.overrides
@click.option("--branches", is_flag=True, help="Also list the assembly branches.")
@options.as_json
def check(what: str, overrides: dict[str, Any], branches: bool, as_json: bool) -> None:
    """Report freedoms, rank, redundant rows, partition.

    For a scene it also reports whether a run can start, whether the desired trajectory stays in the workspace, and
    whether the controller is stable at the target or along the trajectory.
    """
    with Spinner(f"checking {what}"):
        result = ckc_pin.check(what, overrides, branches=branches)
    if as_json:
        print_json(result.to_dict())
    else:
        print_summary(result.summary())


@click.command(
    epilog=options.format_examples(
        'ckc terms five_bar --q \'{"theta_1": -1.2, "theta_3": -1.9}\' --v \'{"theta_1": 0.4}\''
    )
)
@options.mechanism
@click.option("--q", metavar="JSON", required=True, help="Table of coordinates, rad or m.")
@click.option("--v", metavar="JSON", default="{}", help="Table of rates, rad/s or m/s; missing rates are zero.")
@options.as_json
def terms(mechanism: str, q: str, v: str, as_json: bool) -> None:
    """Print all terms at one state. From independent coordinates alone, sigma and rho compute q_tree and v_tree."""
    loaded = ckc_pin.load(mechanism)
    result = ckc_pin.terms(loaded, options.read_table("--q", q), options.read_table("--v", v))
    if as_json:
        print_json(result.to_dict())
    else:
        print_table(_format_terms(result))


def _format_terms(terms: Terms) -> Group:
    """Return all terms as a table of the coordinates, followed by the matrices."""
    import numpy as np
    from rich.console import Group
    from rich.text import Text

    mechanism = terms.mechanism
    table = create_table("coordinate", "q_tree", "v_tree", "h_tree")
    coordinates = mechanism.tree.to_coordinates(terms.q_tree)
    for k, name in enumerate(mechanism.coordinates):
        table.add_row(name, *(f"{x:.8g}" for x in (coordinates[k], terms.v_tree[k], terms.h_tree[k])))
    parts: list[Any] = [table, Text(f"energy {terms.energy:.8g} J")]
    for name in ("phi", "h"):
        parts.append(Text(f"{name}  {_format_row(np.asarray(getattr(terms, name)))}"))
    for name in ("D_tree", "C_tree", "rho", "rho_dot", "D", "C"):
        parts += [Text(name), *(Text("  " + _format_row(row)) for row in getattr(terms, name))]
    jacobian_rows = zip(terms.at.phi_q, terms.at.phi_z, strict=True)
    parts += [Text("phi_q | phi_z"), *(Text(f"  {_format_row(a)} | {_format_row(b)}") for a, b in jacobian_rows)]
    return Group(*parts)


def _format_row(values: Array) -> str:
    return " ".join(f"{x + 0.0:>14.8g}" for x in values)  # + 0.0 removes the sign of zero


@click.command("compile", epilog=options.format_examples("ckc compile delta", "ckc run delta"))
@options.mechanism
@options.as_json
def compile_(mechanism: str, as_json: bool) -> None:
    """Compile the terms of a mechanism. Later runs use them."""
    from ckc_pin.codegen.library import cache_folder, compile_terms, find_compiled_terms

    loaded, start = ckc_pin.load(mechanism), perf_counter()
    cached = find_compiled_terms(loaded)
    with Spinner(f"compiling {mechanism}"):
        library = cached or compile_terms(loaded, on_written=_announce_compilation)
    seconds = perf_counter() - start
    is_kept = Path(library.path).parent == cache_folder()
    if not is_kept:  # The library is in a temporary folder of this process.
        error_console().print(
            f"not kept: {cache_folder()} cannot be written to; XDG_CACHE_HOME names another folder's parent"
        )
    file = library.path if is_kept else None
    if as_json:
        print_json({"mechanism": loaded.name, "file": file, "compiled": cached is None, "seconds": seconds})
    elif cached:
        print(f"{loaded.name}: its terms were compiled before: {file}")
    else:
        print(f"{loaded.name}: compiled and checked against Pinocchio in {seconds:.1f} s: {file or 'not kept'}")


def _announce_compilation(seconds: float) -> None:
    """Print the expected duration of a long compilation before it starts."""
    if seconds > LONG_S:
        error_console().print(f"the compiler may take {seconds:.0f} s")


@click.command(
    epilog=options.format_examples("ckc keys motor", "ckc keys scene.solver", "ckc keys set_point", "ckc keys | less")
)
@click.argument(
    "table",
    metavar="[TABLE]",
    required=False,
    help="A table, as motor, solver, controller.desired or tracking; or all tables of a file: mechanism, scene, sweep, "
    "identify, calibrate, optimize.",
)
@options.as_json
def keys(table: str | None, as_json: bool) -> None:
    """Print the keys of all files that a user writes.

    A line for each key says its type, its unit, its default and its meaning.
    """
    from ckc_pin.cli.key_tables import FILES, find_tables, format_tables, tables

    selected = [(file, each) for file in FILES for each in tables(file)] if table is None else find_tables(table)
    if as_json:
        print_json({"tables": [each.to_dict() | {"file": file} for file, each in selected]})
        return
    for line in format_tables(selected):
        print(line)
