"""KeyboardInterrupt where it ends a computation whose results so far are kept."""

from __future__ import annotations

from contextlib import contextmanager

TYPE_CHECKING = False  # importing `typing` would delay the signal handlers of `ckc`
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import ThreadPoolExecutor

__all__ = ["CommandInterrupt", "acknowledge", "interrupt_again", "uninterrupted_thread"]


class CommandInterrupt(KeyboardInterrupt):
    """A signal to the `ckc` command, which raises it again until it is acknowledged: some libraries swallow it."""

    acknowledged = False


def acknowledge(interrupt: KeyboardInterrupt) -> str:
    """Take note that an interrupt is dealt with; return by which signal, " by SIGTERM" or an empty text."""
    if isinstance(interrupt, CommandInterrupt):
        interrupt.acknowledged = True
    return f" by {interrupt}" if str(interrupt) else ""


def interrupt_again(message: str) -> KeyboardInterrupt:
    """Return the interrupt that ended a run, from the run's message."""
    return KeyboardInterrupt("SIGTERM") if "SIGTERM" in message else KeyboardInterrupt()


@contextmanager
def uninterrupted_thread(initializer: Callable[[], None] | None = None) -> Iterator[ThreadPoolExecutor]:
    """Give a pool of one thread, for work that KeyboardInterrupt must not stop half-way; wait for it at the end.

    Python raises KeyboardInterrupt in the main thread only. The thread is started before there is work for it: a pool
    forgets a thread, and does not wait for it, if `submit` is interrupted while the thread starts.
    """
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1, initializer=initializer) as pool:
        pool.submit(int).result()
        yield pool
