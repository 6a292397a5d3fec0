"""Parameters from simulated motions that runs are fitted to, against the values they were simulated with."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom

import ckc_pin
from ckc_pin import InputError, NumericalError, identify, load
from ckc_pin.control.controllers import RecordedTorques
from tests.contract.helpers.command import ckc

TRUE = {
    "joint.theta_1.friction": 0.02, "joint.theta_2.friction": 0.004, "joint.theta_3.friction": 0.015,
    "joint.theta_4.friction": 0.003, "joint.theta_1.damping": 0.01, "joint.theta_3.damping": 0.012,
}  # fmt: skip
DISSIPATION = ["joint.*.friction", "joint.theta_1.damping", "joint.theta_3.damping"]
START = {"q": [-1.2, -1.0], "q_dot": [0.5, -2.0]}
KNOTS = np.arange(0.0, 3.01, 0.02)
TORQUES = np.array([0.6 * np.sin(9 * KNOTS) + 0.3 * np.cos(4 * KNOTS) + 0.3, 0.5 * np.cos(11 * KNOTS) - 0.2]).T
EXACT = {"rtol": 1e-12, "atol": 1e-13}


@cache
def run_five_bar(t_end=1.0, dt=0.01, start=(-1.2, -1.0, 0.5, -2.0), driven=False):
    """Return a run with friction; its torques are interpolated between the knots of TORQUES."""
    controller = RecordedTorques(KNOTS, TORQUES, interpolates=True) if driven else None
    run = ckc_pin.simulate(
        load("five_bar", TRUE), t_end=t_end, formulation="dae", controller=controller,
        initial={"q": start[:2], "q_dot": start[2:]}, solver={**EXACT, "output_dt": dt},
    )  # fmt: skip
    assert run.status == "done"
    return run


def measure(run, quantities=("theta_1", "theta_3"), noise=0.0, seed=0, driven=False):
    """Return measurements of a run of the five-bar, and its torques."""
    random = np.random.default_rng(seed)
    data = {"t": run.t} | {name: run[name] + noise * random.normal(size=len(run.t)) for name in quantities}
    for motor, tau in zip(("theta_1", "theta_3"), TORQUES.T, strict=True):
        data[f"tau.{motor}"] = np.interp(run.t, KNOTS, tau) if driven else np.zeros(len(run.t))
    return data


def require_truth(result, truth, tolerance):
    for name, value in truth.items():
        assert result.parameters[name].verdict == "identified"
        assert result.parameters[name].value == pytest.approx(value, abs=tolerance)


def test_exact_free_swing_gives_friction_and_masses():
    start = {"link.link_2.mass": 0.2, "link.link_4.mass": 0.4, "joint.theta_2.damping": 1e-3}
    result = identify(
        load("five_bar", start), measure(run_five_bar()), [*DISSIPATION, "link.link_2.mass", "link.link_4.mass"],
        method="motion",
    )  # fmt: skip
    assert result.method == "motion"
    assert max(x.rms for x in result.residuals.values()) > 1e-5  # the start's damping of theta_2 is wrong and not fitted
    start.pop("joint.theta_2.damping")
    result = identify(
        load("five_bar", start), measure(run_five_bar()), [*DISSIPATION, "link.link_2.mass", "link.link_4.mass"],
        method="motion",
    )  # fmt: skip
    require_truth(result, {**TRUE, "link.link_2.mass": 0.2611, "link.link_4.mass": 0.2611}, 1e-7)
    assert not result.warnings
