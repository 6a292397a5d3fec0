"""The stability suite: cases x formulations x methods, each measured against a reference of its own, and long runs."""

from __future__ import annotations

from collections.abc import Collection

from joblib import Parallel, delayed, parallel_config

from scripts.experiments.stability.cases import GROUPS
from scripts.experiments.stability.cell import Cell, run_case
from scripts.experiments.stability.long_runs import LONG, LongRun, long_run

__all__ = ["LONG_RUNS", "NAMES", "measure"]

WORKERS = 2
LONG_RUNS = "long"
NAMES = (*GROUPS, LONG_RUNS)


def measure(names: Collection[str]) -> tuple[list[Cell], list[LongRun]]:
    """Run groups of `NAMES` by two processes, the long runs first."""
    long = [delayed(long_run)(*args) for args in LONG] if LONG_RUNS in names else []
    rows = [delayed(_one)(group, case.name) for group in GROUPS if group in names for case in GROUPS[group]()]
    with parallel_config("loky", n_jobs=WORKERS, inner_max_num_threads=1):
        found = Parallel(verbose=5)([*long, *rows])
    return [cell for row in found[len(long) :] for cell in row], found[: len(long)]


def _one(group: str, name: str) -> list[Cell]:
    """Find a case again in another process: its reference is a function, which cannot be sent."""
    return run_case(next(case for case in GROUPS[group]() if case.name == name))
