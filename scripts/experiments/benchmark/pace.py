"""Seconds of one right-hand side, as the step loop calls it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.mechanism.tree import Array

__all__ = ["motion", "seconds"]

STATES, SPACING = 20, 1e-4  # how many, and s between them
ROUNDS, MOST_ROUNDS = 3, 60
LONG = 0.3  # s, of all rounds, unless that is fewer than the least number of them


def motion(loop: Any) -> Array:
    """Return the first states of a started loop's motion by the midpoint rule, so that sigma has something to correct.

    Returns
    -------
    (STATES, 1 + len(y)) array
        Rows of t and y.
    """
    y, h, found = loop.y, SPACING, []
    for k in range(STATES):
        found.append([k * h, *y])
        y = y + h * loop.rhs((k + 0.5) * h, y + 0.5 * h * loop.rhs(k * h, y))
    return np.array(found)


def seconds(loop: Any) -> float:
    """Return the mean over these states of a right-hand side's time, s, the least of several rounds."""
    states = motion(loop)
    once = float(loop.seconds(states, 1)) * STATES
    return float(loop.seconds(states, int(np.clip(LONG / once, ROUNDS, MOST_ROUNDS))))
