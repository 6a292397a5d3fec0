"""Some seeds of the fuzz suite: random motions of shipped and random mechanisms are correct."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ckc_pin
from ckc_pin.kinematics.sigma import sigma
from scripts.experiments.fuzz.joint_forces import ControlMismatch, JointForces, read_joint_forces
from scripts.experiments.fuzz.main import check_seed, open_motion
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.read import read_model
from scripts.experiments.fuzz.record import run_motion
from scripts.experiments.fuzz.reference import ReferenceIntegrator

ANGLE, RATE = st.floats(-3.14, 3.14), st.floats(-20, 20)


REGRESSION_SEEDS_SHIPPED = [100193]  # an output row was on another branch
REGRESSION_SEEDS_RANDOM = [301017]  # Radau accepted wrong steps with a Jacobian dominated by noise


@pytest.mark.parametrize("seed", [*range(8), *REGRESSION_SEEDS_SHIPPED])
def test_random_motions_of_shipped_mechanisms_are_correct(seed: int) -> None:
    record = check_seed(seed, "shipped")
    assert record.verdict in ("done", "stopped", "refused"), record
    assert not record.failed_before_stop, record


@pytest.mark.parametrize("seed", [*range(8), *REGRESSION_SEEDS_RANDOM])
def test_random_motions_of_random_mechanisms_are_correct(seed: int) -> None:
    record = check_seed(seed, "random")
    assert record.verdict in ("done", "stopped", "refused"), record
    assert not record.failed_before_stop, record


@settings(max_examples=10, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(ANGLE, ANGLE, RATE, RATE, st.floats(-10, -2), st.sampled_from(["reduced", "spf", "dae"]))
def test_five_bar_motions_from_any_state_are_correct(
    q_1: float, q_3: float, rate_1: float, rate_3: float, digits: float, formulation: str
) -> None:
    if sigma(ckc_pin.load("five_bar"), np.array([q_1, q_3])).verdict != "converged":
        return
    overrides = {
        "formulation": formulation,
        "t_end": 1.0,
        "solver.rtol": 10**digits,
        "solver.output_dt": 0.004,
        "solver.max_rhs": 200_000,
        "initial": {"q": {"theta_1": q_1, "theta_3": q_3}, "q_dot": {"theta_1": rate_1, "theta_3": rate_3}},
    }
    record, _ = run_motion(Motion(0, "five_bar", "five_bar/swing", overrides))
    assert record.verdict in ("done", "stopped", "refused"), record


SET_POINT = {"type": "set_point", "K_P": 5.0, "K_V": 1.0, "q_d": {"theta_1": -1.2, "theta_3": 1.9}}
SAMPLED = {**SET_POINT, "sample_time": 0.004, "delay": 0.0068}


@pytest.mark.parametrize("controller", [SET_POINT, SAMPLED, {**SET_POINT, "torque_limit": 0.5}])
@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_controlled_motions_are_checked_with_their_control_law(controller: dict[str, Any], formulation: str) -> None:
    """The suite implements the control law independently: other gains, limits or delays contradict the run."""
    overrides = {
        "formulation": formulation,
        "t_end": 0.3,
        "solver.rtol": 1e-7,
        "solver.output_dt": 0.0004,
        "initial": {"q": {"theta_1": -1.0, "theta_3": 1.5}, "q_dot": {"theta_1": 1.0, "theta_3": 3.0}},
        "controller": controller,
    }
    record, run = run_motion(Motion(0, "five_bar", "five_bar/swing", overrides))
    assert run is not None
    assert (record.verdict, record.fault, record.unresolved) == ("done", "", 0)
    assert record.segments >= 3
    assert record.worst < 100
    model = read_model(run.texts)
    for other in ({"K_P": 5.01}, {"K_V": 1.01}, {"torque_limit": 0.4}, {"sample_time": 0.004, "delay": 0.006}):
        with pytest.raises(ControlMismatch):
            read_joint_forces({**controller, **other}, model, run, 0.0004)


def test_reference_integrator_applies_joint_forces() -> None:
    reference = ReferenceIntegrator(read_model(dict(ckc_pin.load("five_bar").sources.texts)))
    at = ckc_pin.load("five_bar").assembled
    order = [ckc_pin.load("five_bar").coordinates.index(label) for label in reference.model.labels]
    columns = np.array([reference.model.labels.index(name) for name in ("theta_1", "theta_3")])
    q, dt = at.q_tree[order][None], np.array([1e-3])
    free, pushed = (
        reference.integrate_segments(q, 0 * q, dt, 1e-9, JointForces(columns, np.array([[u, 0.0]]))) for u in (0.0, 1.0)
    )
    D = ckc_pin.Terms(ckc_pin.load("five_bar"), at, np.zeros(4)).D
    gained = (pushed.v - free.v)[0][columns] / dt
    assert np.abs(gained - np.linalg.solve(D, [1.0, 0.0])).max() < 1e-3 * np.abs(gained).max()


def test_suite_rejects_an_inaccurate_run() -> None:
    """A run with tolerance 1e-3 fails the check of a run with 1e-9."""
    with open_motion(10, "shipped", "five_bar") as motion:
        coarse = replace(
            motion, overrides={**motion.overrides, "formulation": "dae", "solver.rtol": 1e-3, "t_end": 1.0}
        )
        record, run = run_motion(coarse)
    assert record.verdict == "done"
    assert run is not None
    assert record.worst * 1e-3 > 1e3 * 1e-9
