"""Run the stability suite: cases in several formulations and methods, and long runs."""

from __future__ import annotations

from collections.abc import Collection

from joblib import Parallel, delayed, parallel_config

from scripts.experiments.stability.cases import GROUPS
from scripts.experiments.stability.cell import Cell, run_case
from scripts.experiments.stability.long_runs import LONG_RUN_SETTINGS, LongRun, long_run

__all__ = ["LONG_RUNS", "NAMES", "measure"]

WORKERS = 2
LONG_RUNS = "long"
NAMES = (*GROUPS, LONG_RUNS)


def measure(names: Collection[str]) -> tuple[list[Cell], list[LongRun]]:
    """Run groups of `NAMES` in parallel processes, the long runs first."""
    long = [delayed(long_run)(*args) for args in LONG_RUN_SETTINGS] if LONG_RUNS in names else []
    rows = [delayed(_one)(group, case.name) for group in GROUPS if group in names for case in GROUPS[group]()]
    with parallel_config("loky", n_jobs=WORKERS, inner_max_num_threads=1):
        results = Parallel(verbose=5)([*long, *rows])
    return [cell for row in results[len(long) :] for cell in row], results[: len(long)]


def _one(group: str, name: str) -> list[Cell]:
    """Run a case by its name, since its reference is a function, which cannot be sent to another process."""
    return run_case(next(case for case in GROUPS[group]() if case.name == name))
