"""How far a map has come, for those who wait for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

__all__ = ["Progress", "Steps"]

T = TypeVar("T")
Progress = Callable[[float], None]  # called with the part done, 0 to 1


class Steps:
    """Counts pieces of work, taken to be of one size."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0
        self.step(0)

    def after(self, result: T) -> T:
        """Say that the piece that gave this result is done."""
        self.step()
        return result

    def step(self, count: int = 1) -> None:
        """Say that some more are done."""
        self.done = min(self.done + count, self.total)
        if self.progress is not None:
            self.progress(self.done / self.total)
