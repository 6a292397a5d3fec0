"""Ensembles over numbers of couplings and of motors on several joints, member by member against single runs."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Scene, simulate
from tests.analytic.test_couplings import wheels

VALUES = {
    "motor.m.rotor_inertia": [0.0, 1e-3, 5e-3],
    "coupling.s.joints.b": [-0.4, -0.3, -0.5],
    "coupling.s.offset": [0.2, 0.1, 0.3],
    "motor.m.torque_limit.lower": [-0.2, -0.1, 0.0],
}


@pytest.mark.parametrize("terms", ["pinocchio", "generated"])
def test_members_equal_single_runs(terms: str) -> None:
    motor = {
        "name": "m", "joints": {"a": 1.0, "b": -1.0}, "ratio": 3.0, "rotor_inertia": 1e-3, "torque_limit": [-0.2, 0.1],
    }  # fmt: skip
    coupling = {"joints": {"a": 0.29, "b": -0.4, "c": 1.0}, "offset": 0.2, "name": "s"}
    mechanism = wheels("a", "b", "c", couplings=[coupling], motors=[motor, {"joint": "a"}], independent=["a", "b"])
    law = {"type": "set_point", "K_P": 3.0, "K_V": 0.2, "q_d": {"a": 0.5, "b": 0.1}}
    start = {"q": {"a": 0.6, "b": -0.3}}
    scene = Scene(mechanism, formulation="reduced", initial=start, controller=law, t_end=0.3)
    overrides = {"solver.terms": terms}
    result = ckc_pin.ensemble(scene, VALUES, {"a": "a", "tau": "tau.m"}, overrides=overrides, progress=False)
    ends = []
    for member in range(0, 81, 8):
        values = {name: float(result[name][member]) for name in VALUES}
        run = simulate(scene, {**overrides, **values})
        ends.append(float(run["a"][-1]))
        assert float(result["a"][member]) == ends[-1]
        assert float(result["tau"][member]) == run["tau.m"][-1]
        assert run["tau.m"].min() >= values["motor.m.torque_limit.lower"]
    assert np.ptp(ends) > 0.1
