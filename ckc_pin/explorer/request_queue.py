"""Queue of the page's requests for the worker thread; a newer position of a gesture replaces an older one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Condition

from ckc_pin.explorer.messages import Drag, GoTo, Move, Request, Rewind, SetMotor, SetParameter

__all__ = ["RequestQueue"]

MAX_WAITING = 1000  # requests; further ones are dropped, as a page sends them faster than anyone can act
Positions = (Drag, GoTo, Move, Rewind, SetMotor, SetParameter)


class RequestQueue:
    """Requests in their order, and functions to call between them.

    Of consecutive positions of one gesture only the newest is kept.
    """

    def __init__(self) -> None:
        self._requests: deque[Request | Callable[[], None]] = deque()
        self._changed = Condition()

    def put(self, request: Request | Callable[[], None]) -> None:
        """Add a request, or a function to call. Any thread may call this; it returns at once."""
        with self._changed:
            if self._requests and _replaces(request, self._requests[-1]):
                self._requests[-1] = request
            elif callable(request) or len(self._requests) < MAX_WAITING:
                self._requests.append(request)
            self._changed.notify()

    def take(self, timeout: float | None) -> Request | Callable[[], None] | None:
        """Return the next request; wait for one, at most for `timeout` seconds, and return None if there is none."""
        with self._changed:
            if not self._requests:
                self._changed.wait(timeout)
            return self._requests.popleft() if self._requests else None


def _replaces(new: object, old: object) -> bool:
    if type(new) is not type(old) or not isinstance(new, Positions):
        return False
    keys = ("body", "coordinate", "name")
    return all(getattr(new, key, None) == getattr(old, key, None) for key in keys)
