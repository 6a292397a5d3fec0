"""Ctrl-C and SIGTERM: the first one ends what is being done, none of them ends what is being saved."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Interrupts"]


class Interrupts:
    """Turns the two signals into KeyboardInterrupt.

    The first one raises. The second one, which an impatient person sends while the first is being dealt
    with, is let pass; a third one raises again, in case something holds on to the first.
    """

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._interrupted = 0
        self._saving = False
        self._meanwhile: list[int] = []

    def install(self) -> None:
        """Take over both signals from here on, unless whoever started the process has them ignored."""
        self._forget()
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Finish what is inside; a signal that comes meanwhile raises afterwards."""
        self._saving = True
        try:
            yield
        finally:
            self._saving = False
        if self._meanwhile:
            raise _interrupt(self._meanwhile.pop(0))

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._saving:
            self._meanwhile.append(number)
            return
        self._interrupted += 1
        if self._interrupted != 2:
            raise _interrupt(number)


def _interrupt(number: int) -> KeyboardInterrupt:
    return KeyboardInterrupt("SIGTERM") if number == signal.SIGTERM else KeyboardInterrupt()
