"""Interrupts of computations that keep their results so far, and work that must not be interrupted."""

from __future__ import annotations

from contextlib import contextmanager

TYPE_CHECKING = False  # importing `typing` would delay the signal handlers of `ckc`
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import ThreadPoolExecutor

__all__ = ["CommandInterrupt", "acknowledge", "interrupt_again", "uninterrupted_thread"]


class CommandInterrupt(KeyboardInterrupt):
    """A signal to the `ckc` command. It is raised again until it is acknowledged, since some libraries swallow it."""

    acknowledged = False


def acknowledge(interrupt: KeyboardInterrupt) -> str:
    """Mark an interrupt as handled. Return ``" by SIGTERM"`` for that signal, otherwise an empty text."""
    if isinstance(interrupt, CommandInterrupt):
        interrupt.acknowledged = True
    return f" by {interrupt}" if str(interrupt) else ""


def interrupt_again(message: str) -> KeyboardInterrupt:
    """Return the exception of the interrupt that ended a run, according to the run's message."""
    return KeyboardInterrupt("SIGTERM") if "SIGTERM" in message else KeyboardInterrupt()


@contextmanager
def uninterrupted_thread(initializer: Callable[[], None] | None = None) -> Iterator[ThreadPoolExecutor]:
    """Provide a thread for work that KeyboardInterrupt must not stop half-way, and wait for it at the end.

    Python raises KeyboardInterrupt in the main thread only. The thread is started before it gets work: if `submit` is
    interrupted while it starts a thread, the pool forgets that thread and does not wait for it.
    """
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1, initializer=initializer) as pool:
        pool.submit(int).result()
        yield pool
