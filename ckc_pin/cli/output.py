"""Output of commands: one JSON object or a table on standard output, everything else on standard error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from shutil import get_terminal_size
from threading import Timer
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

from ckc_pin.base.summary import to_json
from ckc_pin.cli.signals import STOPPED, interrupt_code, interrupts
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

    from ckc_pin.base.summary import Summary

__all__ = [
    "LONG_S",
    "ProgressBar",
    "Spinner",
    "create_table",
    "error_console",
    "exit_unless_done",
    "format_destination",
    "has_printed_json",
    "is_terminal",
    "make_folder",
    "print_json",
    "print_summary",
    "print_table",
    "print_written",
    "require_file_path",
    "reset_json",
    "skip_figures_without_matplotlib",
    "write_csv",
    "write_file",
]

LONG_S = 10.0  # a command that may take longer announces it
ESTIMATE_DELAY_S = 2.0  # the remaining time is estimated from the progress in this time
SPINNER_DELAY_S = 1.0  # operations that take less show no spinner


# --- standard error ------------------------------------------------------------------------------


@cache
def error_console() -> Console:
    """Return the console of standard error. It is created on first use, so that other commands do not import rich."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


def is_terminal() -> bool:
    """Return whether standard error is a terminal."""
    return sys.stderr.isatty() and error_console().is_terminal


@contextmanager
def skip_figures_without_matplotlib() -> Iterator[None]:
    """Print the InputError of a body that draws figures instead of raising it: the command's result is saved."""
    try:
        yield
    except InputError as error:
        error_console().print(f"no figures: {error}")


def exit_unless_done(status: str, message: str) -> None:
    """Print the message and exit with code 3, 130 or 143 if a result's status is "stopped" or "interrupted"."""
    import click

    sys.stdout.flush()
    if status != "done":
        error_console().print(message)
        raise click.exceptions.Exit(STOPPED if status == "stopped" else interrupt_code(message))


# --- standard output -----------------------------------------------------------------------------


_printed_json: list[str] = []  # the object of --json, from the moment when it begins to be printed


def print_json(data: dict[str, Any]) -> None:
    """Print the object of --json."""
    _printed_json.append(to_json(data))
    print(_printed_json[-1])


def has_printed_json() -> bool:
    """Return whether the object of --json has been printed, at least in part."""
    return bool(_printed_json)


def reset_json() -> None:
    """Prepare for another command line in the same process."""
    _printed_json.clear()


def create_table(*titles: str, right: tuple[str, ...] = ()) -> Table:
    """Return an empty table without frame; the columns `right` are aligned to the right."""
    from rich.table import Table

    table = Table(*titles, box=None, show_header=any(titles) or bool(right), pad_edge=False)
    for title in right:
        table.add_column(title, justify="right")
    return table


def print_table(table: RenderableType) -> None:
    """Print a table on standard output."""
    from rich.console import Console

    Console(highlight=False, markup=False, emoji=False).print(table)


def print_summary(summary: Summary) -> None:
    """Print a summary in the full width of the terminal, without importing rich."""
    print(summary.text(get_terminal_size().columns, None))


def print_written(paths: list[Path]) -> None:
    """Print the files that were written."""
    for path in paths:
        print(f"written: {path}")


class _HasCsv(Protocol):
    def to_csv(self, path: str | Path) -> Any: ...


def write_csv(result: _HasCsv, path: Path | None, as_json: bool) -> None:
    """Write a result as a CSV file, if a path was given."""
    if path is not None:
        write_file(result.to_csv, path, as_json)


def write_file(write: Callable[[Path], object], path: Path, as_json: bool) -> None:
    """Write a file while signals are deferred, and print its path."""
    with interrupts.deferred():
        write(path)
    if not as_json:
        print_written([path])


def format_destination(out: Path | None, content: str) -> str:
    """Return where results were written, or which content --out would save."""
    return f"not saved: --out DIR keeps {content}" if out is None else f"written to {out}"


def make_folder(out: Path, option: str = "--out ") -> None:
    """Create a folder and check before a computation that files can be written to it.

    Raises
    ------
    InputError
        The folder cannot be written to. `option` is the command's name of it.
    """
    import tempfile

    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"{option}{out}: no folder that can be written to: {error.strerror}") from None


def require_file_path(path: Path | None, option: str) -> None:
    """Check before a computation that a file can be written, if one is asked for, and create its folder.

    Raises
    ------
    InputError
        It is a folder, or its folder cannot be written to.
    """
    if path is not None and path.is_dir():
        raise InputError(f"{option} {path}: expected the name of a file, got a folder")
    if path is not None:
        make_folder(path.parent, f"{option} {path}: ")


# --- progress ------------------------------------------------------------------------------------


class ProgressBar:
    """Progress bar with the remaining time. Its context value is a callback that takes progress and total.

    Without a terminal one line is printed instead, if the command is going to take more than `LONG_S`.
    """

    def __init__(self, title: str, label: str = "t = {task.completed:.2f} s") -> None:
        self.title, self.label = title, label
        self.bar: Any = None
        self.first_call: tuple[float, float] | None = None  # time and progress
        self.has_estimated = False

    @classmethod
    def percentage(cls, title: str) -> ProgressBar:
        """Return a bar that shows the progress in per cent."""
        return cls(title, "{task.percentage:.0f} %")

    def __enter__(self) -> Callable[[float, float], None]:
        """Start the bar and return its callback."""
        if not is_terminal():
            return self._estimate
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(self.label))
        self.bar = Progress(*columns, TimeRemainingColumn(), console=error_console(), transient=True)
        task = self.bar.add_task(self.title, total=1.0)
        self.bar.start()
        return lambda progress, total: self.bar.update(task, completed=progress, total=total)

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        if self.bar is not None:
            self.bar.stop()

    def _estimate(self, progress: float, total: float) -> None:
        """Print the remaining time once, `ESTIMATE_DELAY_S` after the first call. The preparation does not count."""
        if self.has_estimated or not 0 <= progress < total:
            return
        now = perf_counter()
        start, start_progress = self.first_call = self.first_call or (now, progress)
        if now - start < ESTIMATE_DELAY_S or progress <= start_progress:
            return
        self.has_estimated = True
        remaining = (now - start) * (total - progress) / (progress - start_progress)
        if now - start + remaining > LONG_S:
            error_console().print(f"{self.title}: about {remaining:.0f} s more")


class Spinner:
    """Spinner for an operation of unknown duration. It appears after `SPINNER_DELAY_S`, and only on a terminal."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.display: Any = None
        self.timer: Timer | None = None

    def __enter__(self) -> None:
        """Start the timer that shows the spinner."""
        if is_terminal():
            from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            self.display = Progress(*columns, console=error_console(), transient=True)
            self.display.add_task(self.title)
            self.timer = Timer(SPINNER_DELAY_S, self.display.start)
            self.timer.daemon = True
            self.timer.start()

    def __exit__(self, *_: object) -> None:
        """Remove the spinner."""
        if self.timer is not None:
            self.timer.cancel()
            self.timer.join()
            self.display.stop()
