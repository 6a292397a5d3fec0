"""Allocations of the step loop: none a step, so that a stretch of many steps makes as many as one of few.

How tracking control answers to the state, which an implicit method asks for now and then, is a page of matrices that
are made anew each time, as many: those are counted by Jacobian.
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
    ("five_bar/tracking", {"solver.method": "DOP853"}),  # "auto" asks now and then whether it is stiff, and that does
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
VARIED: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("five_bar/swing", {"formulation": "dae"}, ("gravity.y",)),
    ("five_bar/swing", {"formulation": "dae", "solver.terms": "generated"}, ("gravity.y", "link.link_2.mass")),
    ("five_bar/set_point", {"formulation": "dae", "solver.terms": "generated"}, ("gravity.y", "controller.K_P")),
]


def main(library: Path) -> int:
    counter = CDLL(str(library)).allocations
    counter.restype = c_long
    bad = 0
    for scene, overrides, parameters in [*((*x, ()) for x in SCENES), *VARIED]:
        ready = prepare(
            load_scene(scene, overrides), set_up_sensitivities=sensitivity_setup(parameters) if parameters else None
        )
        loop = ready.loop
        instants = np.linspace(0.0, 0.3, 31)
        rows = np.empty((40, loop.width))
        ready.begin()
        loop.record(instants, rows)

        def stretch(end: float, loop: Any = loop) -> tuple[int, int, int]:
            stats, before = loop.stats(), counter()
            loop.advance(end, final=False, pause=60.0, budget=60.0)
            made = counter() - before
            now = loop.stats()
            return made, now.steps - stats.steps, now.jacobians - stats.jacobians

        stretch(0.1)  # whatever grows has grown
        few, short, once = stretch(0.12)
        many, long, often = stretch(0.3)
        print(f"{scene} {overrides or ''} {' '.join(parameters)}: {few} allocations in {short} steps, {many} in {long}")
        jacobians = often / once if once and ready.scene.spec.controller else 1.0
        bad += many > few * jacobians or long < 2 * short
    return 1 if bad else 0
