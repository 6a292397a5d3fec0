"""What is there, before anything moves: list, check, terms; and terms compiled for what is to move."""

from __future__ import annotations

from pathlib import Path

import click

import ckc_pin
from ckc_pin.cli import options
from ckc_pin.cli.arguments import read_overrides, read_table
from ckc_pin.cli.output import LONG, Working, errors, print_json, print_summary, print_table
from ckc_pin.cli.tables import terms_table

__all__ = ["check", "compile_", "list_", "terms"]


@click.command("list", epilog=options.examples("ckc list"))
@options.as_json
def list_(as_json: bool) -> None:
    """Shipped mechanisms and scenes, a line each."""
    from ckc_pin.scene.scene import list_catalogue

    entries = list_catalogue()
    if as_json:
        print_json({"mechanisms": [{"name": n, "about": about, "scenes": scenes} for n, about, scenes in entries]})
        return
    for name, about, scenes in entries:
        print(f"{name:<22} {about}")
        for scene, says in scenes.items():
            print(f"  {name + '/' + scene:<30} {says}")


@click.command(
    epilog=options.examples(
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
    help="A shipped name, a folder or a file; of a folder, the mechanism.",
)
@options.overrides
@click.option("--branches", is_flag=True, help="List the assembly branches too.")
@options.as_json
def check(what: str, overrides: tuple[str, ...], branches: bool, as_json: bool) -> None:
    """Freedoms, rank, redundant rows, partition.

    Of a scene whether a run begins at all, whether its desired trajectory stays in the workspace, and whether its
    controller is stable about the target or along that trajectory.
    """
    with Working(f"checking {what}"):
        found = ckc_pin.check(what, read_overrides("--set", overrides), branches=branches)
    if as_json:
        print_json(found.to_dict())
    else:
        print_summary(found.summary())


@click.command(
    epilog=options.examples('ckc terms five_bar --q \'{"theta_1": -1.2, "theta_3": -1.9}\' --v \'{"theta_1": 0.4}\'')
)
@options.mechanism
@click.option("--q", metavar="JSON", required=True, help="Table of coordinates, rad or m.")
@click.option("--v", metavar="JSON", default="{}", help="Table of rates, rad/s or m/s; absent: at rest.")
@options.as_json
def terms(mechanism: str, q: str, v: str, as_json: bool) -> None:
    """All terms at one state. Independent coordinates alone: sigma closes the loops, v_tree = rho q_dot."""
    loaded = ckc_pin.load(mechanism)
    found = ckc_pin.terms(loaded, read_table("--q", q), read_table("--v", v))
    if as_json:
        print_json(found.to_dict())
    else:
        print_table(terms_table(found))


def _expected(seconds: float) -> None:
    """Say before it begins that the compiler will take long."""
    if seconds > LONG:
        errors().print(f"the compiler may take {seconds:.0f} s")


@click.command("compile", epilog=options.examples("ckc compile delta", "ckc run delta"))
@options.mechanism
@options.as_json
def compile_(mechanism: str, as_json: bool) -> None:
    """Compile a mechanism's terms, which its runs then take."""
    from time import perf_counter

    from ckc_pin.codegen.library import cache_folder, compile_terms, find_compiled_terms

    loaded, started = ckc_pin.load(mechanism), perf_counter()
    there = find_compiled_terms(loaded)
    with Working(f"compiling {mechanism}"):
        library = there or compile_terms(loaded, on_written=_expected)
    seconds = perf_counter() - started
    kept = Path(library.path).parent == cache_folder()
    if not kept:  # in a folder that goes with this process
        errors().print(f"not kept: {cache_folder()} cannot be written to; XDG_CACHE_HOME names another folder's parent")
    file = library.path if kept else None
    if as_json:
        print_json({"mechanism": loaded.name, "file": file, "compiled": there is None, "seconds": seconds})
    elif there:
        print(f"{loaded.name}: its terms were compiled before: {file}")
    else:
        print(f"{loaded.name}: compiled and checked against Pinocchio in {seconds:.1f} s: {file or 'not kept'}")
