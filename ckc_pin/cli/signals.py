"""SIGINT and SIGTERM in the process of the `ckc` command, and the exit codes.

The exit codes are 0 (done), 2 (the input is wrong, known before the first step), 3 (the numerics stopped), 130 and 143
(interrupted by SIGINT and SIGTERM). This module is imported before everything else of the command, so it imports
little itself.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from time import monotonic

from ckc_pin.base.interrupt import CommandInterrupt

TYPE_CHECKING = False  # importing `typing` would take longer than the rest of this module
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

__all__ = ["DONE", "INTERRUPTED", "STOPPED", "TERMINATED", "WRONG_INPUT", "Interrupts", "interrupt_code",
           "interrupts"]  # fmt: skip

DONE, WRONG_INPUT, STOPPED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143  # exit codes

RETRY_PERIOD_S, IMPORT_PATIENCE_S = 0.03, 0.5
EXIT_PATIENCE_S = 0.5  # for the exit functions after an interrupt: Dask's waits 10 s for a cluster that is half begun
IMPORT_SYSTEM = "<frozen importlib._bootstrap>"  # the file name of its frames
COMMAND = "ckc_pin.cli.app"  # the module that calls a command's function


class Interrupts:
    """Handlers of SIGINT and SIGTERM for the whole life of the process.

    - While the program's modules are imported there is nothing to keep: the process ends at once.
    - While a command is at work the first signal raises KeyboardInterrupt. The second one, which an impatient person
      sends while the first one is being dealt with, is ignored. A third one raises again.
    - Some libraries swallow a KeyboardInterrupt, or turn it into another error, above all while they are imported. So
      none is raised inside an import, for `IMPORT_PATIENCE_S`. One that nobody is dealing with after `RETRY_PERIOD_S`
      is raised again.
    - Within `deferred`, and from `finish` on, signals are only noted.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self._loading = self._finished = self._deferring = False
        self._received = 0
        self._deferred: list[int] = []
        self._number = 0  # the signal that is being dealt with
        self._since = 0.0  # when it arrived, s
        self._raised: CommandInterrupt | None = None

    def install(self, loading: bool = False) -> None:
        """Handle both signals from here on, unless the parent process has them ignored.

        Parameters
        ----------
        loading : bool
            A signal ends the process at once, until `start_command`.
        """
        self._reset()
        self._loading = loading
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)

    def start_command(self) -> None:
        """Raise KeyboardInterrupt for every later signal; the imports are done."""
        self._loading = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer signals until the body is complete, then raise KeyboardInterrupt if one arrived."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if self._deferred:
            number = self._deferred[0]
            self._deferred.clear()
            self._raise(number, sys._getframe())

    @property
    def pending(self) -> CommandInterrupt | None:
        """The interrupt that no part of the program has acknowledged."""
        if not self._number or (self._raised is not None and self._raised.acknowledged):
            return None
        return self._raised or _interrupt(self._number)

    def finish(self) -> None:
        """Only note signals from here on: the command has printed everything and knows its exit code."""
        self._finished = self._deferring = True
        if self.pending is not None:  # postponed or swallowed until now
            self._deferred.append(self._number)

    def exit(self, code: int) -> NoReturn:
        """Run the exit functions and end the process, so that no signal meets an interpreter that is half gone."""
        self.finish()
        if code in (INTERRUPTED, TERMINATED):
            signal.signal(signal.SIGALRM, lambda number, frame: os._exit(code))
            signal.setitimer(signal.ITIMER_REAL, EXIT_PATIENCE_S)
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):  # closed, or none at all
                stream.flush()
        self._loading, self._deferring = True, False
        if self._deferred and code not in (INTERRUPTED, TERMINATED):
            _exit_at_once(self._deferred[0], answers=False)
        os._exit(code)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._deferring:
            self._deferred.append(number)
            return
        self._received += 1
        if self._loading:
            _exit_at_once(number, answers=not self._finished and "--json" in sys.argv)
        if self._received == 1 and _innermost_caller(frame) == IMPORT_SYSTEM:
            self._retry_soon(number)
        elif self._received != 2:
            self._raise(number, frame)

    def _raise(self, number: int, frame: FrameType | None) -> NoReturn:
        if _innermost_caller(frame):
            self._retry_soon(number)
        self._raised = _interrupt(number)
        raise self._raised

    def _retry_soon(self, number: int) -> None:
        """Have `_retry` called every `RETRY_PERIOD_S`."""
        self._number, self._raised, self._since = number, None, self._since or monotonic()
        sys.unraisablehook = _ignore  # what a destructor says of an object whose construction was interrupted
        signal.signal(signal.SIGALRM, self._retry)
        signal.setitimer(signal.ITIMER_REAL, RETRY_PERIOD_S, RETRY_PERIOD_S)

    def _retry(self, _: int, frame: FrameType | None) -> None:
        """Raise the KeyboardInterrupt that was postponed or swallowed, unless it is being dealt with."""
        caller = _innermost_caller(frame)
        waits = caller == IMPORT_SYSTEM and monotonic() - self._since < IMPORT_PATIENCE_S
        if not caller or self._finished or self.pending is None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        elif not (waits or self._deferring or _is_being_handled(self._raised)):
            self._raise(self._number, frame)


interrupts = Interrupts()


def interrupt_code(message: str) -> int:
    """Return the exit code after an interrupt, whose message names the signal if it is SIGTERM."""
    return TERMINATED if "SIGTERM" in message else INTERRUPTED


def _innermost_caller(frame: FrameType | None) -> str:
    """Return IMPORT_SYSTEM within an import, COMMAND elsewhere within a command, and an empty text outside of it."""
    while frame is not None:
        if frame.f_code.co_filename == IMPORT_SYSTEM:
            return IMPORT_SYSTEM
        if frame.f_globals.get("__name__") == COMMAND:
            return COMMAND
        frame = frame.f_back
    return ""


def _is_being_handled(interrupt: CommandInterrupt | None) -> bool:
    """Return whether the main thread is in an `except` or `finally` clause because of an interrupt."""
    error = sys.exception()
    while error is not None and error is not interrupt:
        error = error.__context__
    return error is not None


def _interrupt(number: int) -> CommandInterrupt:
    return CommandInterrupt("SIGTERM") if number == signal.SIGTERM else CommandInterrupt()


def _ignore(_: sys.UnraisableHookArgs) -> None:
    pass


def _exit_at_once(number: int, answers: bool) -> NoReturn:
    """End the process where there is nothing to clean up; say why, with `answers` also as the object of --json."""
    terminated = number == signal.SIGTERM
    message = "by SIGTERM" if terminated else "by Ctrl-C"
    with suppress(OSError):
        os.write(2, f"interrupted: {message}\n".encode())
        if answers:
            os.write(1, f'{{"status": "interrupted", "message": "{message}"}}\n'.encode())
    os._exit(TERMINATED if terminated else INTERRUPTED)
