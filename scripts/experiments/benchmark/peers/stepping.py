"""A program with a fixed step: stepped to each instant, timed without what is read out in between."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.initial import find_start
from scripts.experiments.benchmark.row import Motion
from scripts.experiments.benchmark.work import INSTANTS, Work

__all__ = ["CONTROLLED", "divided", "halved", "start_of", "stepped"]

TRIAL = 50  # steps, to foresee how long all take
REPEATS, ENOUGH = 3, 0.05  # s of repeats, and three at least
SHORT = 1.0  # s: what takes less is repeated

# why a program is not run on a controlled motion
CONTROLLED = (
    "the law of a controlled motion needs D, C and h of the reduced model, which it does not give; to call ours from "
    "it would time ours"
)

State = tuple[Array, Array]  # q_tree, v_tree by coordinate


def start_of(work: Work) -> State:
    """Return Pinocchio's q_tree and the v_tree that a work starts with."""
    start = find_start(work.mechanism, work.load())
    return start.at.q_tree, start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree


def halved(work: Work, coarsest: float, many: int) -> list[float]:
    """Return steps that halve from the coarsest on, shorter by as much as a motion is shorter than two seconds."""
    first = coarsest * min(1.0, work.t_end / 2)
    return [first / 2**k for k in range(many)]


def divided(work: Work, dt: float) -> float:
    """Return the step nearest to dt of which whole ones lead from instant to instant."""
    between = work.t_end / INSTANTS
    return between / max(1, round(between / dt))


def stepped(
    work: Work,
    dt: float,
    reset: Callable[[], None],
    step: Callable[[int], None],
    state: Callable[[], State],
    budget: float,
) -> Motion:
    """Run a work with a fixed step, the nearest to dt that divides the instants.

    Parameters
    ----------
    reset : callable
        Puts the program at the start.
    step : callable
        step(k) takes k steps.
    state : callable
        Returns q_tree and v_tree.
    budget : float
        s; where more is foreseen the run is refused.
    """
    none = np.empty((0, work.mechanism.n))
    many = round(work.t_end / INSTANTS / divided(work, dt))
    walls: list[float] = []
    try:
        reset()
        began = perf_counter()
        step(min(TRIAL, many))
        foreseen = (perf_counter() - began) / min(TRIAL, many) * many * INSTANTS
        if foreseen > budget:
            return Motion("refused", f"would take {foreseen:.0f} s, the budget is {budget:.0f} s", none, none, 0.0, 0.0)
        while not walls or (walls[-1] < SHORT and (len(walls) < REPEATS or sum(walls) < ENOUGH)):
            wall, states = _timed(lambda: step(many), reset, state)
            walls.append(wall)
    except Exception as error:  # whatever a program raises where its solver fails
        return Motion("failed", " ".join(str(error).split()) or type(error).__name__, none, none, 0.0, 0.0)
    q_tree, v_tree = (np.array(rows) for rows in zip(*states, strict=True))
    return Motion("done", "", q_tree, v_tree, min(walls), 0.0, steps=many * INSTANTS)


def _timed(
    advance: Callable[[], None], reset: Callable[[], None], state: Callable[[], State]
) -> tuple[float, list[State]]:
    """Advance from instant to instant; return the time that took and the states."""
    reset()
    states, wall = [state()], 0.0
    for _ in range(INSTANTS):
        began = perf_counter()
        advance()
        wall += perf_counter() - began
        states.append(state())
        if not np.all(np.isfinite(states[-1][0])):
            break
    return wall, states
