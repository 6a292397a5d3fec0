"""Ratios of the native core to Python, both sides in one process, the least of several repetitions each."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin import simulate
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.native import unavailable
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene
from ckc_pin.study.report.pace import motion, seconds

SPF = {"formulation": "spf", "solver.spf_equation": 17}
REDUCED = {"formulation": "reduced"}
TIGHT = {"solver.rtol": 1e-8}


def least(once: Callable[[], float], times: int) -> float:
    return min(once() for _ in range(times))


def rhs_seconds(scene: str, changes: dict[str, Any], backend: str) -> float:
    """Seconds of a right-hand side as the step loop of its backend calls it."""
    loaded = load_scene(scene, {**changes, "solver.backend": backend})
    system = prepare(loaded).system
    return seconds(system, motion(system, loaded.spec.t_end))


def rhs_ratio(scene: str, changes: dict[str, Any]) -> float:
    return rhs_seconds(scene, changes, "python") / rhs_seconds(scene, changes, "native")


def against_pinocchio() -> float:
    system: Any = prepare(load_scene("five_bar/swing", {**SPF, "solver.backend": "native"})).system
    own, theirs, _ = system.native.seconds(np.array([[t, *y] for t, y in motion(system, 2.0, 50)]), 1000)
    return float(own / theirs)


def run_seconds(scene: str, changes: dict[str, Any], backend: str, times: int) -> float:
    """Seconds of integration with its outputs, without the loading of the scene."""
    module = import_module("ckc_pin.simulation.simulate")
    steps = module._steps
    spent: list[float] = []

    def timed(*parts: Any) -> Any:
        started = perf_counter()
        try:
            return steps(*parts)
        finally:
            spent.append(perf_counter() - started)

    module._steps = timed
    try:
        for _ in range(times):
            simulate(scene, {**changes, "solver.backend": backend})
    finally:
        module._steps = steps
    return min(spent)


def run_ratio(scene: str) -> float:
    return run_seconds(scene, TIGHT, "python", 3) / run_seconds(scene, TIGHT, "native", 10)


def threads_ratio() -> float:
    """Right-hand sides of two systems in two threads, against one after the other."""
    scene = load_scene("five_bar/swing", {**SPF, "solver.backend": "native"})
    systems: list[Any] = [prepare(scene).system for _ in range(2)]
    states = np.array([[t, *y] for t, y in motion(systems[0], 2.0, 50)])
    motion(systems[1], 2.0, 50)

    def work(system: Any) -> None:
        system.native.seconds(states, 10_000)

    def once(workers: int) -> float:
        with ThreadPoolExecutor(workers) as pool:
            started = perf_counter()
            list(pool.map(work, systems))
            return perf_counter() - started

    return least(lambda: once(1), 3) / least(lambda: once(2), 3)


def import_ratio() -> float:
    """Processor time of both imports, from bytecode: nobody compiles a package's sources at every start."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def once(module: str) -> float:
        code = f"from time import process_time; import {module}; print(process_time())"
        return float(subprocess.check_output([sys.executable, "-c", code], env=environment))

    once("ckc_pin")
    return least(lambda: once("ckc_pin"), 9) / least(lambda: once("pinocchio"), 9)


def main() -> int:
    """Print a Markdown table; exit 1 when a ratio misses what is asked of it."""
    if reason := unavailable():
        print(f"bench_native: {reason}", file=sys.stderr)
        return 2
    rows: list[tuple[str, Callable[[], float], str, float]] = [
        ("five-bar SPF right-hand side, Python / native", lambda: rhs_ratio("five_bar/swing", SPF), ">=", 10),
        ("the same, native / Pinocchio's own calls", against_pinocchio, "<=", 1.7),
        ("five_bar/swing, Python / native", lambda: run_ratio("five_bar/swing"), ">=", 12),
        ("five_bar/tracking, Python / native", lambda: run_ratio("five_bar/tracking"), ">=", 8),
        ("delta/default, with a free root, Python / native", lambda: run_ratio("delta/default"), ">=", 5),
        ("Andrews, right-hand side", lambda: rhs_ratio("andrews", REDUCED), ">=", 5),
        ("Bricard, right-hand side", lambda: rhs_ratio("bricard", REDUCED), ">=", 5),
        ("N-four-bar, N = 40", lambda: rhs_ratio("n_four_bar", {**REDUCED, "mechanism.N": 40}), ">=", 3),
        ("N-four-bar, native, N = 160 / N = 40", wide_ratio, "<=", 6),
        ("two threads, speed of two runs / one", threads_ratio, ">=", 1.7),
        ("import ckc_pin / import pinocchio", import_ratio, "<=", 1.3),
    ]
    print("| what | ratio | asked for |\n|---|---|---|")
    missed = 0
    with one_blas_thread():
        for what, measure, sense, bound in rows:
            ratio = measure()
            met = ratio >= bound if sense == ">=" else ratio <= bound
            missed += not met
            print(f"| {what} | {ratio:.2f} | {sense} {bound}{'' if met else ', missed'} |", flush=True)
    return 1 if missed else 0


def wide_ratio() -> float:
    wide, narrow = (rhs_seconds("n_four_bar", {**REDUCED, "mechanism.N": N}, "native") for N in (160, 40))
    return wide / narrow


if __name__ == "__main__":
    sys.exit(main())
