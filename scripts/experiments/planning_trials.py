"""Random motions from one configuration to another: how many are planned, and why others are not.

Both ends are random configurations in the aspect of the assembled one, to which a straight line in q leads from there,
and in which the motors can hold the mechanism. Each task is planned from the program's own initial guess and replayed
in the step loop.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from time import perf_counter

import numpy as np

import ckc_pin
from ckc_pin import Mechanism
from ckc_pin.base.arrays import Array
from ckc_pin.optimization.free_path import FreeSpace
from ckc_pin.optimization.limits import make_limits
from ckc_pin.optimization.spec import LimitsSpec
from scripts.experiments.identification_trials import load_case

__all__ = ["CASES", "main", "make_tasks", "run_task"]

REPLAY, CLOSURE = 1e-6, 1e-10  # rad, rad/s, m, m/s; largest |phi|
MAX_HOLDING_SHARE = 0.7  # of the torque limit: largest torque that holds an end


@dataclass(frozen=True)
class Case:
    """Tasks of a mechanism.

    Attributes
    ----------
    tasks : int
    torque : float
        Limit of the motors, N m or N.
    spread : float
        rad, or sizes of the mechanism: largest difference of q from the assembled configuration.
    share : float
        Smallest required share of solved tasks.
    """

    tasks: int
    torque: float
    spread: float
    share: float = 0.95


CASES = {
    "five_bar": Case(120, 2.0, np.pi),
    "delta": Case(40, 5.0, 1.0),
    "leg": Case(20, 3.0, 1.0),
    "three_rrr": Case(20, 1.0, 1.0),
}


@dataclass(frozen=True)
class TaskResult:
    """Result of a task: the reason of a failure, "" if there is none, wall time in s, and the replay's error."""

    reason: str
    seconds: float
    error: float = np.nan


def load(name: str) -> Mechanism:
    """Return the mechanism of a case."""
    return load_case("leg") if name == "leg" else ckc_pin.load(name)


def make_tasks(mechanism: Mechanism, case: Case, count: int, seed: int = 0) -> list[tuple[Array, Array]]:
    """Return random starts and ends, (d,) arrays each."""
    random, ends = np.random.default_rng(seed), list[Array]()
    space = FreeSpace(mechanism, make_limits(LimitsSpec(), mechanism), mechanism.q_tree)
    assembled = space.node(mechanism.q_tree)
    while len(ends) < 2 * count:
        step = case.spread * space.scale * random.uniform(-1, 1, (1, mechanism.d))
        node, arrived = space.follow(assembled, step)
        q = node.values[0]
        if arrived[0] and np.abs(ckc_pin.terms(mechanism, q, 0 * q).h).max() <= MAX_HOLDING_SHARE * case.torque:
            ends.append(q)
    return list(zip(ends[::2], ends[1::2], strict=True))


def run_task(mechanism: Mechanism, case: Case, start: Array, end: Array) -> TaskResult:
    """Plan a task and check its replay."""
    names, begin = mechanism.independent, perf_counter()
    tables = [{"q": dict(zip(names, q.tolist(), strict=True))} for q in (start, end)]
    try:
        plan = ckc_pin.optimize(mechanism, start=tables[0], to=tables[1], limits={"torque": case.torque})
    except ckc_pin.CkcError as error:
        return TaskResult(str(error), perf_counter() - begin)
    seconds = perf_counter() - begin
    replay = plan.replay
    checks = {
        f"replay misses the end by {replay.error:.0e}": replay.error > REPLAY,
        f"closure {replay.closure:.0e}": replay.closure > CLOSURE,
        f"torque {replay.max_tau:.4g}": replay.max_tau > case.torque * (1 + 1e-9),
    }
    return TaskResult("; ".join(text for text, fails in checks.items() if fails), seconds, replay.error)


def main(names: Collection[str], tasks: int | None, seed: int) -> int:
    """Print a table of all cases and the reasons of failures; return 1 if a share of solved tasks is too small."""
    reasons, missed = Counter[str](), 0
    print("| mechanism | tasks | solved | median time | largest error of replays |")
    print("|---|---|---|---|---|")
    for name in names:
        mechanism, case = load(name), CASES[name]
        pairs = make_tasks(mechanism, case, tasks or case.tasks, seed)
        results = [run_task(mechanism, case, *pair) for pair in pairs]
        solved = [x for x in results if not x.reason]
        for k, x in enumerate(results):
            if x.reason:
                reasons[f"{name}, task {k}, {x.seconds:.1f} s: {x.reason}"] += 1
        seconds = float(np.median([x.seconds for x in results]))
        error = max((x.error for x in solved), default=np.nan)
        print(f"| {name} | {len(pairs)} | {len(solved)} | {seconds:.1f} s | {error:.0e} |", flush=True)
        missed |= len(solved) < case.share * len(pairs)
    for reason in reasons:
        print(f"- {reason}")
    return int(missed)
