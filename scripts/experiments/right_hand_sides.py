"""Benchmark of one right-hand side by size: compiled terms, Pinocchio's terms, and accelerations by Pinocchio's lcaba.

lcaba is called in C++ without step control, by its fastest setting whose accelerations are accurate enough. A
right-hand side of ckc_pin includes the step loop's work: forces, controller and checks. Both sides are timed one after
the other in one run, at states near the start; the minimum of several repetitions counts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.codegen.library import Library, compile_terms
from ckc_pin.errors import InputError
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import Scene, load_scene
from scripts.experiments.benchmark.growth import ROUNDS, Case, exponent, motion, write_case
from scripts.experiments.benchmark.mechanisms import parallel_chains
from scripts.experiments.benchmark.peers.pinocchio_loop import PinocchioLoop
from scripts.experiments.benchmark.work import Work

__all__ = ["NAMES", "main", "measure"]

SQUARES = ("10", "16", "40", "100", "160", "320", "1000")
NAMES = ("five_bar", "delta", "stewart", "talos", *SQUARES, "chains_40")
ACCURACY = 1e-6  # of lcaba's accelerations, relative to the largest; ckc_pin's have 1e-10 and less
MAX_PEER_COORDINATES = 325  # the workspace of Pinocchio takes 65 n^3 bytes
REPEATS = 5
OVERRIDES: dict[str, Any] = {"formulation": "dae", "solver.method": "DOP853", "solver.terms": "pinocchio"}


@dataclass(frozen=True)
class RightHandSide:
    """Times of one right-hand side of a mechanism, s; None where there is none.

    Attributes
    ----------
    name : str
        A shipped mechanism, a number of squares, or chains_DEPTH.
    n, d : int
    compiled_s, pinocchio_s, lcaba_s : float or None
    """

    name: str
    n: int
    d: int
    compiled_s: float | None
    pinocchio_s: float
    lcaba_s: float | None

    def row(self) -> str:
        """Return the line of the Markdown table."""
        times = [self.compiled_s, self.pinocchio_s, self.lcaba_s]
        ratios = [None if not (ours and self.lcaba_s) else ours / self.lcaba_s for ours in times[:2]]
        cells = ["" if s is None else f"{1e6 * s:.3g}" for s in times] + [
            "" if r is None else f"{r:.2f}" for r in ratios
        ]
        return f"| {self.name} | {self.n} | {self.d} | {' | '.join(cells)} |"


def measure(name: str) -> RightHandSide:
    """Time one right-hand side of a mechanism with every kind of terms."""
    with tempfile.TemporaryDirectory() as folder:
        scene = _scene(name, Path(folder))
        work = Work(name, name, lambda: scene, 1.0)
        try:
            library = compile_terms(work.mechanism)
        except InputError:  # too large
            library = None
        return RightHandSide(
            name,
            work.mechanism.n,
            work.mechanism.d,
            _rhs_s(scene, library) if library else None,
            _rhs_s(scene, None),
            PinocchioLoop("lcaba").acceleration_s(work, ACCURACY) if work.mechanism.n <= MAX_PEER_COORDINATES else None,
        )


def _scene(name: str, folder: Path) -> Scene:
    if name.startswith("chains_"):
        return parallel_chains(int(name.removeprefix("chains_")), 17)
    return load_scene(write_case(Case(int(name), int(name)), folder) if name.isdigit() else f"{name}/default")


def _rhs_s(scene: Scene, library: Library | None) -> float:
    ready = prepare(scene.with_overrides(OVERRIDES), free=True, library=library)
    ready.begin()
    states = motion(ready.loop)
    return min(float(ready.loop.seconds(states, ROUNDS)) for _ in range(REPEATS))


def main(names: Sequence[str] = ()) -> None:
    """Print a Markdown table, and the exponent with which the time grows with the number of squares."""
    print("| mechanism or N | n | d | compiled, µs | Pinocchio's terms, µs | lcaba, µs | compiled / lcaba |"
          " Pinocchio's / lcaba |\n|---|---:|---:|---:|---:|---:|---:|---:|")  # fmt: skip
    by_squares: dict[float, float] = {}
    with one_blas_thread():
        for name in names or NAMES:
            result = measure(name)
            if name.isdigit():
                by_squares[float(name)] = result.pinocchio_s
            print(result.row(), flush=True)
    growth = exponent(by_squares, whole=True)
    if growth is not None:
        print(f"\nWith Pinocchio's terms a right-hand side of N squares grows as N^{growth:.2f}.")
