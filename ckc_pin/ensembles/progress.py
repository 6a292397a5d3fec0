"""How far an ensemble is, how fast, and how long it will take: a bar on a terminal and in a notebook."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import contextmanager
from html import escape
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ckc_pin.base.summary import in_notebook

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
    if in_notebook():
        yield _NotebookBar(title, there)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr, highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
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


class _NotebookBar:
    """The page's own element below the cell, which stays there with the last it said; it needs no widgets."""

    def __init__(self, title: str, there: int) -> None:
        self.title, self.there = title, there
        self.began = perf_counter()
        self.shown: Any = None

    def __call__(self, done: int, total: int) -> None:
        """Say how far it is."""
        from IPython.display import display

        seconds = perf_counter() - self.began
        rate = (done - self.there) / seconds if seconds > 0 else 0.0
        left = f", {(total - done) / rate:.0f} s left" if rate > 0 and done < total else ""
        said = f"{done} of {total} members, {rate:.3g} a second{left}"
        bundle = {
            "text/plain": f"{self.title}: {said}",
            "text/html": f'{escape(self.title)} <progress value="{done}" max="{total}"></progress> {said}',
        }
        if self.shown is None:
            self.shown = display(bundle, raw=True, display_id=True)  # type: ignore[no-untyped-call]
        else:
            self.shown.update(bundle, raw=True)
