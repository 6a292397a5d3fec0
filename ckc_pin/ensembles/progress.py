"""Progress of an ensemble: a bar on a terminal and in a notebook, with rate and remaining time."""

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

__all__ = ["Advance", "show_progress"]

Advance = Callable[[int, int], None]  # takes the numbers of finished members and of all members


@contextmanager
def show_progress(title: str, finished_before: int) -> Iterator[Advance | None]:
    """Show a progress bar while a `with` block runs.

    Parameters
    ----------
    title : str
    finished_before : int
        Members from an earlier command, which do not count for the rate.

    Yields
    ------
    callable or None
        Function that updates the bar; None without a terminal or notebook.
    """
    if in_notebook():
        yield _NotebookBar(title, finished_before)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr, highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as progress:
        task: Any = progress.add_task(title, total=None, completed=finished_before, rate="")

        def advance(finished: int, total: int) -> None:
            elapsed = progress.tasks[0].elapsed or 0.0
            new = finished - finished_before
            rate = f"{new / elapsed:.0f} a second" if elapsed > 0 and new > 0 else ""
            progress.update(task, completed=finished, total=total, rate=rate)

        yield advance


class _NotebookBar:
    """A progress bar in a notebook, an HTML element below the cell. It needs no widgets."""

    def __init__(self, title: str, finished_before: int) -> None:
        self.title, self.finished_before = title, finished_before
        self.started = perf_counter()
        self.handle: Any = None

    def __call__(self, finished: int, total: int) -> None:
        """Update the bar."""
        from IPython.display import display

        elapsed = perf_counter() - self.started
        rate = (finished - self.finished_before) / elapsed if elapsed > 0 else 0.0
        remaining = f", {(total - finished) / rate:.0f} s left" if rate > 0 and finished < total else ""
        text = f"{finished} of {total} members, {rate:.3g} a second{remaining}"
        bundle = {
            "text/plain": f"{self.title}: {text}",
            "text/html": f'{escape(self.title)} <progress value="{finished}" max="{total}"></progress> {text}',
        }
        if self.handle is None:
            self.handle = display(bundle, raw=True, display_id=True)  # type: ignore[no-untyped-call]
        else:
            self.handle.update(bundle, raw=True)
