"""Allocations of the native step loop: none a step, so that a stretch of many steps makes as many as one of few."""

import sys
from ctypes import CDLL, c_long
from typing import Any

import numpy as np

from ckc_pin.simulation.burst import Burst
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.record import Recorder
from ckc_pin.simulation.scene import load_scene

TRACKING = {"solver.method": "DOP853", "solver.spf_equation": 17}
SCENES: list[tuple[str, dict[str, Any]]] = [
    ("five_bar/swing", {}),
    ("five_bar/swing", {"formulation": "reduced"}),
    ("five_bar/tracking", {}),
    ("five_bar/tracking", TRACKING),
    ("three_rrr/default", {"formulation": "reduced"}),
    ("n_four_bar", {"mechanism.N": 20, "formulation": "dae", "solver.rtol": 1e-11}),
    ("delta/default", {}),
    ("delta/circle", TRACKING),
]


def loop_of(scene: str, changes: dict[str, Any]) -> tuple[Any, Stepper]:
    """A native loop that has begun, and what it steps."""
    loaded = load_scene(scene, {**changes, "solver.backend": "native"})
    ready = prepare(loaded)
    stepper = Stepper(ready.system, ready.method, loaded.spec.solver, loaded.spec.t_end)
    recorder = Recorder(ready.system, ready.plant.effort, None)
    burst = Burst(stepper, RankGuard(stepper), recorder, np.zeros(0), lambda until, end: until)
    loop, solver = burst._loop(), stepper.solver
    loop.begin(0.0, solver.y, getattr(solver, "f", solver.y), solver.h_abs, *stepper.before)
    if stepper.method == "BDF":
        loop.remember(solver.D, solver.order, solver.n_equal_steps, solver.J)
    return loop, stepper


def main() -> int:
    counter = CDLL(sys.argv[1]).allocations
    counter.restype = c_long
    bad = 0
    for scene, changes in SCENES:
        loop, stepper = loop_of(scene, changes)
        instants = np.linspace(0.0, 0.3, 31)

        def stretch(end: float, loop: Any = loop, instants: Any = instants) -> tuple[int, int]:
            due = instants[(instants > loop.t) & (instants <= end)]
            before = counter()
            loop.go(end, 0.0, 2**62, 60.0, end, True, due, 64)
            made = counter() - before
            return made, loop.counts()[0]

        stretch(0.1)  # whatever grows has grown
        few, short = stretch(0.12)
        many, long = stretch(0.3)
        print(f"{scene} ({stepper.method}): {few} allocations in {short} steps, {many} in {long}")
        bad += many > few + 1 or long < 2 * short  # one for the rows, where there were any
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
