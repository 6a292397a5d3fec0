"""Random motions from one configuration to another: how many are planned, and why others are not.

Both ends are random configurations in the aspect of the assembled one, to which a straight line in q leads from there,
and in which the motors can hold the mechanism. Motions that cross singular configurations begin at the assembled one
and end in a random one where det phi_z has the other sign. Each task is planned from the program's own initial guess
and replayed in the step loop.
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
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.optimization.free_path import FreeSpace, is_separated
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
    crosses_in : tuple of str
        Motions cross singular configurations. Their ends are drawn in these coordinates.
    """

    tasks: int
    torque: float
    spread: float
    share: float = 0.95
    crosses_in: tuple[str, ...] = ()


CASES = {
    "five_bar": Case(120, 2.0, np.pi),
    "delta": Case(40, 5.0, 1.0),
    "leg": Case(20, 3.0, 1.0),
    "three_rrr": Case(20, 1.0, 1.0),
    "five_bar_crossing": Case(50, 3.0, np.pi, 1.0, ("theta_1", "theta_2")),
    "three_rrr_crossing": Case(20, 5.0, 1.5, 0.95, ("a_1", "b_1", "c_1")),
}


@dataclass(frozen=True)
class TaskResult:
    """Result of a task: the reason of a failure, "" if there is none, wall time in s, and the replay's error."""

    reason: str
    seconds: float
    error: float = np.nan


def load(name: str) -> Mechanism:
    """Return the mechanism of a case."""
    return load_case("leg") if name == "leg" else ckc_pin.load(name.removesuffix("_crossing"))


Configuration = dict[str, float]  # coordinates by name


def make_tasks(
    mechanism: Mechanism, case: Case, count: int, seed: int = 0
) -> list[tuple[Configuration, Configuration]]:
    """Return random starts and ends."""
    if case.crosses_in:
        return _make_crossings(mechanism, case, count, seed)
    random, ends = np.random.default_rng(seed), list[Array]()
    space = FreeSpace(mechanism, make_limits(LimitsSpec(), mechanism), mechanism.q_tree)
    assembled = space.node(mechanism.q_tree)
    while len(ends) < 2 * count:
        step = case.spread * space.scale * random.uniform(-1, 1, (1, mechanism.d))
        node, arrived = space.follow(assembled, step)
        q = node.values[0]
        if arrived[0] and np.abs(ckc_pin.terms(mechanism, q, 0 * q).h).max() <= MAX_HOLDING_SHARE * case.torque:
            ends.append(q)
    named = [dict(zip(mechanism.independent, q.tolist(), strict=True)) for q in ends]
    return list(zip(named[::2], named[1::2], strict=True))


def _make_crossings(
    mechanism: Mechanism, case: Case, count: int, seed: int
) -> list[tuple[Configuration, Configuration]]:
    random, ends = np.random.default_rng(seed), list[Configuration]()
    other, limits = mechanism.with_independent(case.crosses_in), make_limits(LimitsSpec(), mechanism)
    scale, start = mechanism.tree.step_scale[other.partition.q], other.independent_part(mechanism.q_tree)
    while len(ends) < count:
        end = sigma(other, start + case.spread * scale * random.uniform(-1, 1, mechanism.d), other.assembled)
        if end.verdict == "converged" and is_separated(mechanism, limits, mechanism.q_tree, end.at.q_tree):
            numbers = mechanism.tree.to_coordinates(end.at.q_tree)
            turned = np.where(mechanism.tree.is_angle, (numbers + np.pi) % (2 * np.pi) - np.pi, numbers)
            turned[other.partition.q] = numbers[other.partition.q]
            ends.append(dict(zip(mechanism.coordinates, turned.tolist(), strict=True)))
    begin = dict(zip(mechanism.independent, mechanism.independent_part(mechanism.q_tree).tolist(), strict=True))
    return [(begin, end) for end in ends]


def run_task(mechanism: Mechanism, case: Case, start: Configuration, end: Configuration) -> TaskResult:
    """Plan a task and check its replay."""
    begin = perf_counter()
    try:
        plan = ckc_pin.optimize(mechanism, start={"q": start}, to={"q": end}, limits={"torque": case.torque},
                                cross_singularities=bool(case.crosses_in))  # fmt: skip
    except ckc_pin.CkcError as error:
        return TaskResult(str(error), perf_counter() - begin)
    seconds = perf_counter() - begin
    replay = plan.replay
    checks = {
        f"replay misses the end by {replay.error:.0e}": replay.error > REPLAY,
        f"closure {replay.closure:.0e}": replay.closure > CLOSURE,
        f"torque {replay.max_tau:.4g}": replay.max_tau > case.torque * (1 + 1e-9),
        "no crossing": bool(case.crosses_in) and not plan.crossings,
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
