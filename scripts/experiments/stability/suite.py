"""The stability suite: cases x formulations x methods, each measured against a reference of its own, and long runs."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from scripts.experiments.stability.cases import GROUPS
from scripts.experiments.stability.cell import Cell, run_case
from scripts.experiments.stability.long_runs import LONG, LongRun, long_run
from scripts.experiments.stability.page import as_csv, page, satisfied, tally

ROOT = Path(__file__).resolve().parents[3]
WORKERS = 2
LONG_RUNS = "long"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the suite, or some groups of it; write the page, or print it. Returns 1 where the suite is not satisfied."""
    names = (*GROUPS, LONG_RUNS)
    parser = argparse.ArgumentParser(prog="stability", description=__doc__)
    parser.add_argument("group", nargs="*", help=f"print these groups alone: {', '.join(names)}")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder for page and table (docs)")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.group if name not in names]
    if unknown:
        parser.error(f"no group {unknown[0]!r}; there are {', '.join(names)}")
    cells, long_runs = measure(options.group or names)
    text = page(cells, long_runs)
    if options.group:
        print(text)
    else:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "stability.md").write_text(text, encoding="utf-8")
        (options.out / "stability.csv").write_text(as_csv(cells), encoding="utf-8")
        print(f"{len(cells)} cells: {tally(cells)}; written: {options.out / 'stability.md'}, stability.csv")
    return 0 if not cells or satisfied(cells) else 1


def measure(names: Sequence[str]) -> tuple[list[Cell], list[LongRun]]:
    """Run groups by two processes, the long runs first; a line on standard error for each case that is done."""
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # small matrices: more threads only wait for each other
        os.environ.setdefault(threads, "1")
    chosen = [case for name in GROUPS if name in names for case in GROUPS[name]()]
    with ProcessPoolExecutor(WORKERS, mp_context=multiprocessing.get_context("spawn")) as pool:
        long = [pool.submit(long_run, *args) for args in LONG] if LONG_RUNS in names else []
        rows = [pool.submit(_one, case.group, case.name) for case in chosen]
        both: list[Future[Any]] = [*long, *rows]
        for count, done in enumerate(as_completed(both), 1):
            print(f"[{count}/{len(both)}] {_said(done.result())}", file=sys.stderr, flush=True)
        return [cell for row in rows for cell in row.result()], [run.result() for run in long]


def _said(found: list[Cell] | LongRun) -> str:
    if isinstance(found, LongRun):
        return f"{LONG_RUNS}: {found.name}, {found.formulation}: {found.outcome}"
    return f"{found[0].group}: {found[0].case}: {tally(found)}"


def _one(group: str, name: str) -> list[Cell]:
    """Find a case again in another process: its reference is a function, which cannot be sent."""
    return run_case(next(case for case in GROUPS[group]() if case.name == name))


if __name__ == "__main__":
    sys.exit(main())
