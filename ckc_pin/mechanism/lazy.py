"""Values computed when first asked for, and a tally of what that cost."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any, Generic, TypeVar, overload

__all__ = ["Tally", "lazy"]

T = TypeVar("T")


class Tally:
    """How often each lazy value was evaluated and the seconds it took, its own inputs excluded.

    Attributes
    ----------
    calls, seconds : dict of str to number
        By name of the value.
    """

    def __init__(self) -> None:
        self.calls: dict[str, int] = {}
        self.seconds: dict[str, float] = {}
        self._inner = 0.0  # time spent in values that the one being computed asked for

    def plain(self) -> dict[str, dict[str, float]]:
        """Return {name: {calls, seconds}}, the most expensive first."""
        names = sorted(self.calls, key=lambda name: -self.seconds[name])
        return {name: {"calls": self.calls[name], "seconds": self.seconds[name]} for name in names}

    def measure(self, name: str, compute: Callable[[Any], T], owner: Any) -> T:
        """Compute one value and book it."""
        outer, self._inner = self._inner, 0.0
        start = perf_counter()
        try:
            return compute(owner)
        finally:
            spent = perf_counter() - start
            self.calls[name] = self.calls.get(name, 0) + 1
            self.seconds[name] = self.seconds.get(name, 0.0) + spent - self._inner
            self._inner = outer + spent


class lazy(Generic[T]):
    """A property computed once per object.

    Like `functools.cached_property` without its lock (which costs more than some of our values on
    Python 3.11), and booked in the object's `tally` when it has one.
    """

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self.compute = compute
        self.name = compute.__name__
        self.__doc__ = compute.__doc__

    @overload
    def __get__(self, owner: None, kind: type) -> lazy[T]: ...
    @overload
    def __get__(self, owner: object, kind: type) -> T: ...
    def __get__(self, owner: Any, kind: type) -> Any:
        if owner is None:
            return self
        tally: Tally | None = owner.tally
        value = self.compute(owner) if tally is None else tally.measure(self.name, self.compute, owner)
        owner.__dict__[self.name] = value
        return value
