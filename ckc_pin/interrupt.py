"""KeyboardInterrupt where it ends a computation whose results so far are kept."""

from __future__ import annotations

__all__ = ["CommandInterrupt", "acknowledge", "interrupt_again"]


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
