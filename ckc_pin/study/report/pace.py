"""Seconds of one right-hand side, as the step loop of its backend calls it."""

from __future__ import annotations

from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.tree import Array

__all__ = ["motion", "seconds"]

STATES = 20
SPACING = (1e-4, 1e-5)  # s between states, the shorter one where stiff controllers overshoot with the longer
ROUNDS, MOST_ROUNDS = 3, 60
LONG = 0.3  # s, of all rounds, unless that is fewer than the least number of them


def motion(system: Any, t_end: float, states: int = STATES) -> list[tuple[float, Array]]:
    """Return the first states of a system's motion by the midpoint rule, so that sigma has something to correct.

    Raises
    ------
    NumericalError
        There are none, however short the steps.
    """
    *longer, shortest = (min(h, t_end / 2000) for h in SPACING)
    for h in longer:
        with suppress(NumericalError):
            return _midpoint(system, h, states)
    return _midpoint(system, shortest, states)


def _midpoint(system: Any, h: float, states: int) -> list[tuple[float, Array]]:
    y = system.start()
    found = []
    for k in range(states):
        found.append((k * h, y))
        slope = system.rhs(k * h, y)
        y = y + h * system.rhs((k + 0.5) * h, y + 0.5 * h * slope)
    return found


def seconds(system: Any, states: list[tuple[float, Array]]) -> float:
    """Return the mean over states of a right-hand side's time, s, the least of several rounds.

    A native system whose force crosses is timed inside its core, where the native step loop calls it.
    """
    with one_blas_thread():
        if getattr(system, "crosses", False):
            table = np.array([[t, *y] for t, y in states])
            once = float(system.native.seconds(table, 1)[0])
            return float(system.native.seconds(table, _rounds(once * len(states)))[0])
        first = _round(system, states)
        return min(_round(system, states) for _ in range(_rounds(first))) / len(states)


def _rounds(seconds: float) -> int:
    """How many rounds to make when one takes so long."""
    return int(np.clip(LONG / seconds, ROUNDS, MOST_ROUNDS))


def _round(system: Any, states: list[tuple[float, Array]]) -> float:
    began = perf_counter()
    for t, y in states:
        system.rhs(t, y)
    return perf_counter() - began
