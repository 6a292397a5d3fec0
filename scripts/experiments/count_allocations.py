"""Check that steps of the loop allocate no memory: an interval of many steps makes as many allocations as one of few.

The state derivatives of a tracking controller do allocate matrices. Implicit methods evaluate them with each Jacobian,
so the allowed number of allocations is multiplied by the number of Jacobians.
"""

from ctypes import CDLL, c_long
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin import load_scene
from ckc_pin.run.prepare import prepare
from ckc_pin.sensitivity.parameters import sensitivity_setup

EVENT = {"coordinate": "theta_1", "value": 50.0}
SCENES: list[tuple[str, dict[str, Any]]] = [
    ("five_bar/swing", {}),
    ("five_bar/swing", {"formulation": "reduced"}),
    ("five_bar/swing", {"formulation": "reduced", "solver.method": "RK45"}),
    ("five_bar/swing", {"formulation": "reduced", "solver.method": "Radau"}),
    ("five_bar/swing", {"formulation": "spf", "initial.w": [0.01, -0.006], "epsilon": 1e-2}),
    ("five_bar/swing", {"formulation": "spf", "spf_coordinates": "z", "epsilon": 1e-2}),
    ("five_bar/swing", {"event": [EVENT, {"of": "sigma_min_J", "value": 1e-3}]}),
    ("five_bar/tracking", {"solver.method": "DOP853"}),  # "auto" allocates when it tests for stiffness
    ("five_bar/tracking", {"solver.method": "Radau"}),
    ("five_bar/tracking", {"controller.sample_time": 1e-3}),
    ("five_bar/swing", {"solver.terms": "generated"}),
    ("five_bar/swing", {"solver.terms": "generated", "solver.method": "Radau"}),
    ("five_bar/swing", {"solver.terms": "generated", "solver.method": "Radau", "formulation": "reduced"}),
    ("flyball", {}),
    ("three_rrr/default", {"formulation": "reduced"}),
    ("n_four_bar", {"mechanism.N": 20, "formulation": "dae", "solver.rtol": 1e-11}),
    ("delta/default", {}),
    ("delta/circle", {}),
]
SENSITIVITY_RUNS: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("five_bar/swing", {"formulation": "dae"}, ("gravity.y",)),
    ("five_bar/swing", {"formulation": "dae", "solver.terms": "generated"}, ("gravity.y", "link.link_2.mass")),
    ("five_bar/set_point", {"formulation": "dae", "solver.terms": "generated"}, ("gravity.y", "controller.K_P")),
]


def main(library: Path) -> int:
    """Print the allocations of two intervals of each run; return 1 if steps allocate. `library` has the counter."""
    counter = CDLL(str(library)).allocations
    counter.restype = c_long
    bad = 0
    for scene, overrides, parameters in [*((*x, ()) for x in SCENES), *SENSITIVITY_RUNS]:
        ready = prepare(
            load_scene(scene, overrides), set_up_sensitivities=sensitivity_setup(parameters) if parameters else None
        )
        loop = ready.loop
        instants = np.linspace(0.0, 0.3, 31)
        rows = np.empty((40, loop.width))
        ready.begin()
        loop.record(instants, rows)

        def advance(end: float, loop: Any = loop) -> tuple[int, int, int]:
            """Advance to a time; return the numbers of allocations, steps and Jacobians."""
            before, allocations = loop.stats(), counter()
            loop.advance(end, final=False, pause=60.0, budget=60.0)
            allocations = counter() - allocations
            after = loop.stats()
            return allocations, after.steps - before.steps, after.jacobians - before.jacobians

        advance(0.1)  # buffers reach their final size
        few, few_steps, few_jacobians = advance(0.12)
        many, many_steps, many_jacobians = advance(0.3)
        name = f"{scene} {overrides or ''} {' '.join(parameters)}"
        print(f"{name}: {few} allocations in {few_steps} steps, {many} in {many_steps}")
        jacobians = many_jacobians / few_jacobians if few_jacobians and ready.scene.spec.controller else 1.0
        bad += many > few * jacobians or many_steps < 2 * few_steps
    return 1 if bad else 0
