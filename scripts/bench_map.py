"""Prints how long the five-bar's map takes, beside one Newton solution a cell without neighbours."""

from time import perf_counter

import numpy as np

from ckc_pin import load
from ckc_pin.study.map import singularity_map

CELLS = 400
SAMPLE = 400  # cells of the naive way, scaled up
LIMIT = 10.0  # s, on two cores


def naive(mechanism) -> float:
    """Seconds for one branch when every cell follows sigma from the assembled configuration, from a sample."""
    some = np.random.default_rng(0).uniform(-np.pi, np.pi, (SAMPLE, 2))
    began = perf_counter()
    for q in some:
        mechanism.sigma(q)
    return (perf_counter() - began) / SAMPLE * CELLS**2


def main() -> None:
    mechanism = load("five_bar")
    singularity_map(mechanism, cells=16)  # loads what is loaded once
    for _ in range(2):
        began = perf_counter()
        found = singularity_map(mechanism, cells=CELLS)
        every = perf_counter() - began
        print(
            f"{CELLS} x {CELLS} cells, {len(found.sheets)} branches: {found.seconds:.2f} s for the cells, "
            f"{every:.2f} s with {len(found.loci)} loci traced (limit {LIMIT:g} s)"
        )
    print(f"sigma from the assembled configuration for each cell of one branch: {naive(mechanism):.0f} s")


if __name__ == "__main__":
    main()
