"""Look at runs: plot, play."""

from __future__ import annotations

from pathlib import Path

import click

import ckc_pin
from ckc_pin.cli import options
from ckc_pin.cli.output import Working
from ckc_pin.errors import InputError

__all__ = ["play", "plot"]


@click.command(epilog=options.examples("ckc plot runs/reduced runs/spf --out figures"))
@options.runs
@options.out(default=Path(), help="Folder for the figures.")
def plot(runs: tuple[Path, ...], out: Path) -> None:
    """Figures of one or several runs, PNG and SVG."""
    from ckc_pin.view.figures import plot_runs

    with Working("drawing"):
        written = plot_runs([ckc_pin.Run.load(path) for path in runs], out, ("png", "svg"))
    for path in written:
        print(f"written: {path}")


@click.command(
    epilog=options.examples(
        "ckc play runs/spf",
        "ckc play runs/reduced runs/spf --speed 0.5 --gap 1000",
        "ckc play runs/spf --html spf.html",
        "ckc play runs/reduced runs/spf --gif both.gif",
    )
)
@options.runs
@click.option("--html", metavar="FILE", type=options.PATH, help="Write one file that plays from disk instead.")
@click.option("--gif", metavar="FILE", type=options.PATH, help="Write a moving picture of lines instead.")
@click.option("--speed", metavar="FACTOR", type=float, default=1.0, help="Playback speed, 1 is real time.")
@click.option("--gap", metavar="FACTOR", type=float, default=0.0, help="Draw the loops' gaps so much larger.")
@click.option("--forces", is_flag=True, help="Draw the forces of loops and motors as arrows.")
@click.option("--meshes", metavar="DIR", type=options.PATH, help="The mechanism's folder, for its mesh files.")
@options.port
@options.open_browser
def play(
    runs: tuple[Path, ...],
    html: Path | None,
    gif: Path | None,
    speed: float,
    gap: float,
    forces: bool,
    meshes: Path | None,
    port: int,
    open_browser: bool,
) -> None:
    """Watch runs in the browser, on this machine only. Several runs lie on each other."""
    options.check_speed(speed)
    if gif is not None and (html is not None or gap or forces or meshes is not None):
        raise InputError("--gif draws lines alone: it goes with --speed, not with --html, --gap, --forces or --meshes")
    loaded = [ckc_pin.Run.load(path) for path in runs]
    if gif is not None:
        from ckc_pin.view.gif import save_gif

        with Working(f"writing {gif.name}"):
            written = save_gif(loaded, gif, speed=speed)
        print(f"written: {written}")
        return
    if html is None:
        ckc_pin.play(*loaded, speed=speed, gap=gap, meshes=meshes, forces=forces, port=port, open_browser=open_browser)
        return
    from ckc_pin.view.player import save_html

    with Working(f"writing {html.name}"):
        written = save_html(loaded, html, speed=speed, gap=gap, meshes=meshes, forces=forces)
    print(f"written: {written}")
