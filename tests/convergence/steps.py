"""Advance a loop step by step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ckc_pin.native import StopReason
from tests.analytic.five_bar import Array

__all__ = ["steps_of"]


def steps_of(loop: Any, begin: Callable[[], None], t_end: float) -> Array:
    """Return the ends of the loop's steps to t_end; a pause of zero returns after each step."""
    begin()
    ends: list[float] = []
    while not ends or ends[-1] < t_end:
        stop = loop.advance(t_end, final=True, pause=0.0, budget=math.inf)
        assert stop.reason in (StopReason.PAUSE, StopReason.END)
        if not ends or loop.t > ends[-1]:
            ends.append(loop.t)
    return np.array(ends)
