"""Prints how long the five-bar's map takes."""

from time import perf_counter

from ckc_pin import load
from ckc_pin.analysis.map import singularity_map

CELLS = 400
LIMIT = 10.0  # s, on two cores


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


if __name__ == "__main__":
    main()
