"""A share of the fuzz suite: random motions of shipped and random mechanisms, none of them raw or wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ckc_pin
from ckc_pin.kinematics.sigma import sigma
from scripts.experiments.fuzz.main import drawn, one
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.record import run_motion

ANGLE, RATE = st.floats(-3.14, 3.14), st.floats(-20, 20)


ONCE_WRONG = [100193]  # an output row on another branch


@pytest.mark.parametrize("seed", [*range(8), *ONCE_WRONG])
def test_random_motions_of_shipped_mechanisms_are_right(seed: int) -> None:
    record = one(seed, "shipped")
    assert record.verdict in ("done", "stopped", "refused"), record


@pytest.mark.parametrize("seed", range(8))
def test_random_motions_of_random_mechanisms_are_right(seed: int) -> None:
    record = one(seed, "random")
    assert record.verdict in ("done", "stopped", "refused"), record


@settings(max_examples=10, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(ANGLE, ANGLE, RATE, RATE, st.floats(-10, -2), st.sampled_from(["reduced", "spf", "dae"]))
def test_the_five_bar_moves_right_from_anywhere(
    q_1: float, q_3: float, rate_1: float, rate_3: float, digits: float, formulation: str
) -> None:
    if sigma(ckc_pin.load("five_bar"), np.array([q_1, q_3])).verdict != "converged":
        return
    changes = {
        "formulation": formulation,
        "t_end": 1.0,
        "solver.rtol": 10**digits,
        "solver.output_dt": 0.004,
        "solver.max_rhs": 200_000,
        "initial": {"q": {"theta_1": q_1, "theta_3": q_3}, "q_dot": {"theta_1": rate_1, "theta_3": rate_3}},
    }
    record, _ = run_motion(Motion(0, "five_bar", "five_bar/swing", changes))
    assert record.verdict in ("done", "stopped", "refused"), record


def test_the_suite_sees_a_run_that_is_off() -> None:
    """A run at 1e-3 passed off as one at 1e-9 is found out."""
    with drawn(10, "shipped", "five_bar") as motion:
        coarse = replace(motion, changes={**motion.changes, "formulation": "dae", "solver.rtol": 1e-3, "t_end": 1.0})
        record, run = run_motion(coarse)
    assert record.verdict == "done"
    assert run is not None
    assert record.worst * 1e-3 > 1e3 * 1e-9
