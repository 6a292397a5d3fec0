"""A thread for slow computations of which only the newest one matters."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Thread
from time import perf_counter
from typing import Generic, TypeVar

__all__ = ["NewestTask"]

T = TypeVar("T")
MAX_REST_S = 2.0


class NewestTask(Generic[T]):
    """Compute in a thread of its own. A newer request replaces one that waits.

    Parameters
    ----------
    compute : callable
        Gets a request, and a function that tells whether a newer one waits, so that it can give up.
    name : str
        Of the thread.
    rests : bool
        Rest after a computation for as long as it took, at most `MAX_REST_S`, so that frames get half of the time.
    """

    def __init__(self, compute: Callable[[T, Callable[[], bool]], None], name: str, *, rests: bool = False) -> None:
        self._compute, self._name, self._rests = compute, name, rests
        self._changed = Condition()
        self._waiting: list[T] = []  # at most one
        self._closed = False
        self._thread: Thread | None = None
        self.is_busy = False  # from a request to the end of its computation

    def request(self, what: T) -> None:
        """Compute this next; nothing after `close`."""
        with self._changed:
            if self._closed:
                return
            self._waiting, self.is_busy = [what], True
            self._changed.notify()
            if self._thread is None:
                self._thread = Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Give up the computation and end the thread."""
        with self._changed:
            self._closed, self._waiting, self.is_busy = True, [], False
            self._changed.notify()

    def is_outdated(self) -> bool:
        """Whether a newer request waits, or the task is closed."""
        return bool(self._waiting) or self._closed

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self.is_outdated)
                if self._closed:
                    return
                what = self._waiting.pop()
            start = perf_counter()
            self._compute(what, self.is_outdated)
            with self._changed:
                self.is_busy = bool(self._waiting)
                if self._rests:
                    self._changed.wait_for(lambda: self._closed, min(perf_counter() - start, MAX_REST_S))
