"""Time runs and print them as lines of the benchmark's protocol, for the programs of this folder."""

import json
import math
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

MAX_REPEATS, REPEAT_BELOW_S = 3, 0.2  # of short runs
TRIAL_INSTANTS = 0.01  # part of the interval between two instants from which the time of a run is estimated
TRIAL_BUDGET = 0.02  # part of the budget from which an estimate counts

MIN_MASS = 1e-12  # kg and kg m^2: massless bodies are given this mass, because MuJoCo and Drake take none without

State = tuple[list[float], list[float]]  # q and v of the protocol


def say(**values: Any) -> None:
    """Print one line of the protocol."""
    print(json.dumps(values), flush=True)


def read_inertia(body: dict[str, Any]) -> tuple[float, Any]:
    """Return a body's mass and inertia, raised to `MIN_MASS`."""
    inertia = np.array(body["inertia"])
    smallest = np.linalg.eigvalsh(inertia)[0]
    return max(body["mass"], MIN_MASS), inertia + max(MIN_MASS - smallest, 0.0) * np.eye(3)


def fixed_step(problem: dict[str, Any], coarsest: float) -> tuple[int, float]:
    """Return the number of steps between instants and the step in s.

    It is the coarsest at the tolerance 1e-2, and half as long for each further decade.
    """
    between = problem["instants"][1]
    decades = round(-math.log10(problem["rtol"])) - 2
    dt = coarsest * min(1.0, problem["t_end"] / 2) / 2**decades
    steps = max(1, round(between / dt))
    return steps, between / steps


def print_motion(
    problem: dict[str, Any], reset: Callable[[], None], advance: Callable[[float], None], read: Callable[[], State],
    count_steps: Callable[[], int],
) -> None:  # fmt: skip
    """Run a problem, short ones repeatedly, and print its states and its shortest time.

    A run that would take longer than the budget is refused. `advance` advances to a time.
    """
    instants, budget, walls = problem["instants"], problem["budget_s"], list[float]()
    while not walls or (sum(walls) < REPEAT_BELOW_S and len(walls) < MAX_REPEATS):
        reset()
        states, wall = [read()], 0.0
        for at, t in enumerate(instants[1:]):
            began = perf_counter()
            for part in (TRIAL_INSTANTS, 1.0) if at == 0 else (1.0,):
                advance(instants[at] + part * (t - instants[at]))
                spent = wall + perf_counter() - began
                expected = spent / (at + part) * (len(instants) - 1)
                if spent > TRIAL_BUDGET * budget and expected > budget:
                    return say(unsupported=f"would take {expected:.0f} s, the budget is {budget:.0f} s")
            wall += perf_counter() - began
            states.append(read())
        walls.append(wall)
    say(wall_s=min(walls), steps=count_steps())
    for t, (q, v) in zip(instants, states, strict=True):
        say(t=t, q=q, v=v)
    return None
