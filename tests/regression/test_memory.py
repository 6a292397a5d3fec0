"""Memory does not grow with steps: what a run keeps is its output instants."""

from __future__ import annotations

import gc
import itertools
import tracemalloc

import pytest

from ckc_pin import simulate

EVERY = 10  # steps: when cycles are collected and memory is looked at
SETTLED = 2  # looks, after which everything that is allocated once is there
# bytes a step: the smallest array, kept at each, takes 130; SciPy's BDF and NumPy keep up to 70 for reuse
ALLOWED = {"DOP853": 50, "BDF": 120}


@pytest.mark.parametrize(
    ("scene", "changes"),
    [
        ("five_bar/swing", {"formulation": "reduced"}),
        ("five_bar/swing", {"formulation": "spf", "initial.w": [0.01, -0.006], "epsilon": 0.1}),
        ("five_bar/swing", {"formulation": "dae"}),
        ("five_bar/tracking", {"formulation": "dae", "t_end": 0.5}),
        ("five_bar/swing", {"formulation": "dae", "initial.q_dot": {"theta_1": 6.0, "theta_3": -6.0}}),
    ],
    ids=["reduced", "spf", "dae", "tracking, BDF", "across type 2"],
)
def test_memory_does_not_grow_with_steps(scene: str, changes: dict[str, object]) -> None:
    sizes: list[int] = []
    count = itertools.count(1)

    def look(t: float, t_end: float) -> None:
        if next(count) % EVERY == 0:
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])

    # the native core takes many steps between two looks, and its own test counts its allocations
    every = {"t_end": 3.0, "solver.output_dt": 100.0, "solver.backend": "python", **changes}
    simulate(scene, every)  # what is loaded and kept at first use is there before memory is looked at
    tracemalloc.start()
    try:
        run = simulate(scene, every, progress=look)
    finally:
        tracemalloc.stop()
    assert run.status == "done"
    assert len(sizes) >= SETTLED + 3
    grown = sizes[-1] - sizes[SETTLED]
    assert grown < ALLOWED[run.stats["method"]] * EVERY * (len(sizes) - SETTLED)
