"""How far an ensemble is, how fast, and how long it will take: a bar on a terminal and in a notebook."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Advance", "bar"]

Advance = Callable[[int, int], None]  # members that are there, and in all


@contextmanager
def bar(title: str, there: int) -> Iterator[Advance | None]:
    """Show a bar where somebody looks on; gives a function of how many members are there, and how many there will be.

    Parameters
    ----------
    title : str
    there : int
        Members from before, which say nothing about the rate.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr, highlight=False, markup=False, emoji=False)
    if not (console.is_terminal or console.is_jupyter):
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as shown:
        task: Any = shown.add_task(title, total=None, completed=there, rate="")

        def advance(done: int, total: int) -> None:
            seconds = shown.tasks[0].elapsed or 0.0
            rate = f"{(done - there) / seconds:.0f} a second" if seconds > 0 and done > there else ""
            shown.update(task, completed=done, total=total, rate=rate)

        yield advance
