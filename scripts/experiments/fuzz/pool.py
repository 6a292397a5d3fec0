"""Evaluate seeds in this process or in several, with a counter on a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from typing import TypeVar

__all__ = ["map_seeds"]

T = TypeVar("T")


def map_seeds(function: Callable[[int], T], seeds: Sequence[int], jobs: int, label: str) -> Iterator[T]:
    """Yield the function's results in the order of the seeds. With `jobs` > 1 the function has to be picklable."""
    with ExitStack() as stack:
        results: Iterator[T] = map(function, seeds)
        if jobs > 1:
            pool = stack.enter_context(ProcessPoolExecutor(jobs, initializer=_use_one_thread))
            results = pool.map(function, seeds, chunksize=4)
        for count, result in enumerate(results, 1):
            if sys.stderr.isatty():
                end = "\n" if count == len(seeds) else ""
                print(f"\r{label} {count}/{len(seeds)}", end=end, file=sys.stderr, flush=True)
            yield result


def _use_one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
