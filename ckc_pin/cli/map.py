"""Where a mechanism can go and where it is singular: map."""

from __future__ import annotations

from pathlib import Path

import click

import ckc_pin
from ckc_pin.cli import options
from ckc_pin.cli.output import ProgressBar, errors, make_folder, print_json, print_table
from ckc_pin.errors import InputError

__all__ = ["map_"]


@click.command(
    "map",
    epilog=options.examples(
        "ckc map five_bar --scene tracking --out figures",
        "ckc map five_bar --space cartesian --out figures",
        "ckc map delta --space cartesian --over x,z --out figures",
        "ckc map delta --space cartesian --sections 6 --out figures",
    ),
)
@options.mechanism
@click.option(
    "--scene",
    metavar="SCENE",
    shell_complete=options.complete_scenes,
    help="Draw this scene's desired trajectory on top.",
)
@click.option("--over", metavar="A,B", help="The axes; all others are fixed.")
@click.option(
    "--space", type=click.Choice(["joint", "cartesian"]), default="joint", help="cartesian: where a point goes."
)
@click.option("--point", metavar="POINT", help="A [[point]]; absent: the first one.")
@click.option("--cells", metavar="N", type=int, default=200, help="Along each axis.")
@click.option("--sections", metavar="N", type=int, help="With three freedoms: N heights of the point.")
@options.out(help="Folder for the figure.")
@options.as_json
def map_(
    mechanism: str,
    scene: str | None,
    over: str | None,
    space: str,
    point: str | None,
    cells: int,
    sections: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Where it can go and where it is singular. Branch by branch, as the paper's Fig. 2."""
    from ckc_pin.analysis import map as maps
    from ckc_pin.view.map_figures import require_matplotlib, save_map, save_sections

    if out is not None:
        make_folder(out)
        require_matplotlib()
    if sections is not None and (space != "cartesian" or scene is not None):
        raise InputError("--sections goes with --space cartesian, and without --scene")
    axes = None if over is None else [name.strip() for name in over.split(",")]
    with ProgressBar(f"map of {mechanism}", "{task.percentage:.0f} %") as bar:

        def progress(part: float) -> None:
            bar(part, 1.0)

        if sections is None:
            one = ckc_pin.singularity_map(
                mechanism, scene=scene, space=space, over=axes, point=point, cells=cells, progress=progress
            )
        else:
            stack = maps.workspace_sections(
                mechanism, point=point, over=axes or ("x", "y"), count=sections, cells=cells, progress=progress
            )
    if as_json:
        print_json(one.to_dict() if sections is None else maps.sections_to_dict(stack))
    else:
        print_table(maps.make_map_table(one) if sections is None else maps.make_sections_table(stack))
    if out is None and not as_json:
        print("not drawn: --out DIR draws the map there")
    elif out is not None:
        for path in save_map(one, out) if sections is None else save_sections(stack, out):
            (errors().print if as_json else print)(f"written: {path}")
