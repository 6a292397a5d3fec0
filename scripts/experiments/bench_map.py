"""Benchmark of the five-bar's singularity map."""

from time import perf_counter

from ckc_pin import load
from ckc_pin.analysis.map import singularity_map

LIMIT = 10.0  # s, for 400 x 400 cells on two cores


def main(cells: int) -> None:
    """Compute the map twice and print its times."""
    mechanism = load("five_bar")
    singularity_map(mechanism, cells=16)  # imports and caches are filled before the timing
    for _ in range(2):
        began = perf_counter()
        map_ = singularity_map(mechanism, cells=cells)
        elapsed = perf_counter() - began
        print(
            f"{cells} x {cells} cells, {len(map_.aspects)} branches: {map_.seconds:.2f} s for the cells, "
            f"{elapsed:.2f} s with {len(map_.loci)} loci traced (limit {LIMIT:g} s)"
        )
