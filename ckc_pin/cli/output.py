"""What commands print: one JSON object or a table on standard output, everything else on standard error."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from shutil import get_terminal_size
from threading import Timer
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ckc_pin.base.summary import to_json
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from ckc_pin.base.summary import Summary

__all__ = [
    "LONG",
    "ProgressBar",
    "Working",
    "errors",
    "forget_answer",
    "has_answered",
    "kept",
    "make_folder",
    "on_terminal",
    "print_json",
    "print_summary",
    "print_table",
]  # fmt: skip


LONG = 10.0  # s: what may take longer says so before
FIRST_LOOK = 2.0  # s: from what was done until then the rest is estimated
SOON = 1.0  # s: what takes longer shows that it is at work


@cache
def errors() -> Console:
    """Standard error, for people; a command that has nothing to say there loads no rich."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


def on_terminal() -> bool:
    """Whether somebody is looking on."""
    return sys.stderr.isatty() and errors().is_terminal


_answers: list[str] = []  # the object of --json, once its printing has begun


def print_json(data: dict[str, Any]) -> None:
    """Print the one object of --json."""
    _answers.append(to_json(data))
    print(_answers[-1])


def has_answered() -> bool:
    """Return whether printing the object of --json has begun."""
    return bool(_answers)


def forget_answer() -> None:
    """Begin another command line in this process."""
    _answers.clear()


def print_table(table: RenderableType) -> None:
    """Print what is for people."""
    from rich.console import Console

    Console(highlight=False, markup=False, emoji=False).print(table)


def print_summary(summary: Summary) -> None:
    """Print a summary in the full width of the terminal, without importing rich."""
    print(summary.text(get_terminal_size().columns, None))


def kept(out: Path | None, what: str) -> str:
    """Say where results went, or would go."""
    return f"not saved: --out DIR keeps {what}" if out is None else f"written to {out}"


def make_folder(out: Path, option: str = "--out ") -> None:
    """Find out before a run, not after it, whether it can be saved; `option` is what the command calls the folder."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"{option}{out}: no folder that can be written to: {error.strerror}") from None


class ProgressBar:
    """A bar on a terminal, with the time that is left; in a pipe one line, if it is going to take more than `LONG`.

    Entering it gives a function of how far it is and how far it will be.
    """

    def __init__(self, title: str, says: str = "t = {task.completed:.2f} s") -> None:
        self.title, self.says = title, says
        self.bar: Any = None
        self.first: tuple[float, float] | None = None  # when it was first heard of, and how far it was
        self.said = False

    def __enter__(self) -> Callable[[float, float], None]:
        """Show the bar."""
        if not on_terminal():
            return self._estimate
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

    def _estimate(self, done: float, whole: float) -> None:
        """Say once how long it will take, by what was done in the first `FIRST_LOOK` of it; preparing is no part."""
        if self.said or not 0 <= done < whole:
            return
        now = perf_counter()
        began, at = self.first = self.first or (now, done)
        if now - began < FIRST_LOOK or done <= at:
            return
        self.said = True
        left = (now - began) * (whole - done) / (done - at)
        if now - began + left > LONG:
            errors().print(f"{self.title}: about {left:.0f} s more")


class Working:
    """A sign on a terminal, from `SOON` on, that something is under way whose end nobody knows; nothing in a pipe."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.sign: Any = None
        self.timer: Timer | None = None

    def __enter__(self) -> None:
        """Wait with it."""
        if on_terminal():
            from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            self.sign = Progress(*columns, console=errors(), transient=True)
            self.sign.add_task(self.title)
            self.timer = Timer(SOON, self.sign.start)
            self.timer.daemon = True
            self.timer.start()

    def __exit__(self, *_: object) -> None:
        """Take it away."""
        if self.timer is not None:
            self.timer.cancel()
            self.timer.join()
            self.sign.stop()
