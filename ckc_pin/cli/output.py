"""What commands print: one JSON object or a table on standard output, everything else on standard error."""

from __future__ import annotations

import sys
import tempfile
from functools import cache
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from ckc_pin.errors import InputError
from ckc_pin.simulation.report import to_json

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from ckc_pin.mechanism.card import Card

__all__ = ["ProgressBar", "errors", "make_folder", "on_terminal", "print_card", "print_json", "print_table"]


@cache
def errors() -> Console:
    """Standard error, for people; a command that has nothing to say there loads no rich."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


def on_terminal() -> bool:
    """Whether somebody is looking on."""
    return sys.stderr.isatty() and errors().is_terminal


def print_json(data: dict[str, Any]) -> None:
    """Print the one object of --json."""
    print(to_json(data))


def print_table(table: RenderableType) -> None:
    """Print what is for people."""
    from rich.console import Console

    Console(highlight=False, markup=False, emoji=False).print(table)


def print_card(card: Card) -> None:
    """Print all of a card, as wide as the terminal is; a command that prints no more loads no rich."""
    print(card.text(get_terminal_size().columns, None))


def make_folder(out: Path) -> None:
    """Find out before a run, not after it, whether it can be saved."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"--out {out}: no folder that can be written to: {error.strerror}") from None


class ProgressBar:
    """A bar on a terminal, nothing in a pipe.

    Entering it gives a function of how far it is and how far it will be, or None where nobody looks on.
    """

    def __init__(self, title: str, says: str = "t = {task.completed:.2f} s") -> None:
        self.title, self.says = title, says
        self.bar: Any = None

    def __enter__(self) -> Any:
        """Show the bar."""
        if not on_terminal():
            return None
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(self.says))
        self.bar = Progress(*columns, TimeRemainingColumn(), console=errors(), transient=True)
        task = self.bar.add_task(self.title, total=1.0)
        self.bar.start()
        return lambda t, t_end: self.bar.update(task, completed=t, total=t_end)

    def __exit__(self, *_: object) -> None:
        """Take it away."""
        if self.bar is not None:
            self.bar.stop()
