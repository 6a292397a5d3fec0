"""A program with a fixed step: stepped from instant to instant, timed without what is read out in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ckc_pin.analysis.precision.motion import Motion
from ckc_pin.base.arrays import Array

__all__ = ["REPEATS", "SHORT", "Stepper"]

TRIAL = 50  # steps, to foresee how long all take
REPEATS, ENOUGH, SHORT = 3, 0.05, 1.0  # runs, s of runs: what takes less than the last is repeated


@dataclass(frozen=True)
class Stepper:
    """A program that takes steps.

    Attributes
    ----------
    reset : callable
        Puts it at the start.
    step : callable
        step(k) takes k steps.
    state : callable
        Returns q_tree and v_tree by coordinate.
    """

    reset: Callable[[], None]
    step: Callable[[int], None]
    state: Callable[[], tuple[Array, Array]]

    def foreseen(self, many: int, instants: int) -> float:
        """Return how long it would take, with so many steps between instants, s."""
        self.reset()
        trial = min(TRIAL, many)
        began = perf_counter()
        self.step(trial)
        return (perf_counter() - began) / trial * many * instants

    def run(self, many: int, instants: int) -> Motion:
        """Return its motion, with so many steps between instants, up to where that is not finite."""
        walls: list[float] = []
        while not walls or (sum(walls) < SHORT and (len(walls) < REPEATS or sum(walls) < ENOUGH)):
            self.reset()
            states, wall = [self.state()], 0.0
            for _ in range(instants):
                began = perf_counter()
                self.step(many)
                wall += perf_counter() - began
                states.append(self.state())
                if not np.all(np.isfinite(states[-1][0])):
                    break
            walls.append(wall)
        q_tree, v_tree = (np.array(rows) for rows in zip(*states, strict=True))
        return Motion("done", "", q_tree, v_tree, min(walls), steps=many * instants, used="fixed step")
