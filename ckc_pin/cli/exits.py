"""Exit codes, and the signals that two of them stand for.

0 done; 2 the input is wrong, known before the first step; 3 the numerics stopped; 130 and 143 interrupted.
"""

from __future__ import annotations

from ckc_pin.simulation.interrupts import Interrupts

__all__ = ["DONE", "INTERRUPTED", "STOPPED", "TERMINATED", "WRONG_INPUT", "interrupted", "interrupts"]

DONE, WRONG_INPUT, STOPPED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143

interrupts = Interrupts()


def interrupted(message: str) -> int:
    """Return the exit code of what a signal ended, from what was said of it."""
    return TERMINATED if "SIGTERM" in message else INTERRUPTED
