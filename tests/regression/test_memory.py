"""Memory does not grow with steps: a run stores its output instants only, a simulator nothing."""

from __future__ import annotations

import gc
import tracemalloc
from typing import Any

import numpy as np
import pytest

from ckc_pin import Simulator, load_scene
from ckc_pin.native import StopReason
from ckc_pin.run.prepare import prepare

RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "reduced": ("five_bar/swing", {"formulation": "reduced"}),
    "spf": ("five_bar/swing", {"formulation": "spf", "initial.w": [0.01, -0.006], "epsilon": 0.1}),
    "dae": ("five_bar/swing", {"formulation": "dae"}),
    "tracking, Radau": ("five_bar/tracking", {"formulation": "dae", "t_end": 9.5}),
    "sampled": ("five_bar/tracking", {"controller.sample_time": 2e-3, "controller.delay": 5e-3}),
    "across type 2": ("five_bar/swing", {"formulation": "dae", "initial.q_dot": {"theta_1": 6.0, "theta_3": -6.0}}),
}
ALLOWED = 50  # bytes per step; the smallest array, stored at each step, takes 130


@pytest.mark.parametrize("name", RUNS)
def test_memory_does_not_grow_with_steps(name: str) -> None:
    """Python's memory; scripts/check_native counts allocations of the native loop."""
    scene, overrides = RUNS[name]
    ready = prepare(load_scene(scene, {"t_end": 3.0, **overrides}))
    ready.begin()
    rows = np.empty((2, ready.loop.width))
    ready.loop.record(np.array([ready.scene.spec.t_end]), rows)

    def advance() -> StopReason:
        return ready.loop.advance(ready.scene.spec.t_end, final=True, pause=0.0, budget=60.0).reason  # after each step

    sizes, count = np.zeros(1000), 0  # allocated before, so that measuring needs no memory
    gc.collect()
    gc.freeze()  # so that objects of other tests are not examined each time
    tracemalloc.start()
    try:
        while advance() == StopReason.PAUSE:
            if count % 20 == 0:
                gc.collect()
                sizes[count // 20] = tracemalloc.get_traced_memory()[0]
            count += 1
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    assert count >= 60
    assert sizes[(count - 1) // 20] - sizes[1] <= ALLOWED * (count - 20)


def test_memory_does_not_grow_with_simulator_steps() -> None:
    simulator = Simulator("five_bar/swing", {"formulation": "dae"})
    u = np.zeros(2)

    def step() -> int:
        for _ in range(200):
            simulator.step(u, 1e-3)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    step()
    tracemalloc.start()
    try:
        step()
        before = step()
        after = step()
    finally:
        tracemalloc.stop()
    assert after - before <= 200 * ALLOWED / 10
