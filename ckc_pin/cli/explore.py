"""The command `ckc explore`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ckc_pin.base.interrupt import acknowledge
from ckc_pin.cli import options

__all__ = ["explore"]


@click.command(
    epilog=options.format_examples(
        "ckc explore five_bar --open",
        "ckc explore five_bar/tracking",
        "ckc explore robot.xml --out kept",
        "ckc explore delta --set link.plate.mass=0.5 --open",
    )
)
@click.argument(
    "what",
    metavar="MECHANISM_OR_SCENE",
    shell_complete=options.complete_scenes,
    help="A shipped name or a file; with a scene, a run is under its controller.",
)
@options.overrides
@options.out(help="Existing folder that the page saves into; default: the working directory.")
@options.port
@options.open_browser
def explore(what: str, overrides: dict[str, Any], out: Path | None, port: int, open_browser: bool) -> None:
    """Drag a mechanism in the browser. Its loops stay closed. The page can also change it, and run it."""
    import ckc_pin

    with ckc_pin.explore(what, overrides, out=out, port=port, open_browser=open_browser) as explorer:
        try:
            print(f"{explorer.url}  (Ctrl-C ends)", flush=True)
            explorer.wait()
        except KeyboardInterrupt as stop:
            acknowledge(stop)
            print()
