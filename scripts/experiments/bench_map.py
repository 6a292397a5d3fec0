"""Prints how long the five-bar's map takes."""

from time import perf_counter

from ckc_pin import load
from ckc_pin.analysis.map import singularity_map

LIMIT = 10.0  # s, for 400 x 400 cells on two cores


def main(cells: int) -> None:
    mechanism = load("five_bar")
    singularity_map(mechanism, cells=16)  # loads what is loaded once
    for _ in range(2):
        began = perf_counter()
        found = singularity_map(mechanism, cells=cells)
        every = perf_counter() - began
        print(
            f"{cells} x {cells} cells, {len(found.aspects)} branches: {found.seconds:.2f} s for the cells, "
            f"{every:.2f} s with {len(found.loci)} loci traced (limit {LIMIT:g} s)"
        )
