"""Right-hand sides per second of the N-four-bar: the three formulations, by N, best of several batches."""

from __future__ import annotations

import sys
from time import perf_counter

from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene

NUMBERS = (1, 10, 40, 100, 160)
WAYS = {
    "DAE, eq. 1": {"formulation": "dae"},
    "reduced, eq. 6": {"formulation": "reduced"},
    "SPF, eq. 8": {"formulation": "spf", "solver.spf_equation": 8},
}
BATCH = 0.4  # s
BATCHES = 5


def per_second(N: int, way: str) -> float:
    """Evaluate along a slow motion, as an integrator does, so that sigma has something to correct."""
    system = prepare(load_scene("n_four_bar", {"mechanism.N": N, "solver.backend": "python", **WAYS[way]})).system
    y = system.start()
    rate = system.rhs(0.0, y)
    best, t = 0.0, 0.0
    for _ in range(BATCHES):
        count, started = 0, perf_counter()
        while perf_counter() - started < BATCH:
            t = 1e-4 * (count % 50)
            system.rhs(t, y + t * rate)
            count += 1
        best = max(best, count / (perf_counter() - started))
    return best


def main() -> int:
    """Print a Markdown table."""
    print("| N | coordinates | rows |", " | ".join(WAYS), "|")
    print("|---|---|---|", "|".join("---" for _ in WAYS), "|", sep="")
    with one_blas_thread():
        for N in NUMBERS:
            speeds = [f"{per_second(N, way):,.0f}" for way in WAYS]
            print(f"| {N} | {2 * N + 1} | {2 * N} |", " | ".join(speeds), "|", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
