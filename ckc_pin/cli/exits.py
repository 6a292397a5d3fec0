"""Exit codes.

0 done; 2 the input is wrong, known before the first step; 3 the numerics stopped; 130 and 143 interrupted.
"""

from __future__ import annotations

__all__ = ["DONE", "INTERRUPTED", "STOPPED", "TERMINATED", "WRONG_INPUT", "interrupted"]

DONE, WRONG_INPUT, STOPPED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143


def interrupted(message: str) -> int:
    """Return the exit code of what a signal ended, from what was said of it."""
    return TERMINATED if "SIGTERM" in message else INTERRUPTED
