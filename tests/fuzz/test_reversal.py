"""Fuzz suite: the check by time reversal accepts a correct run and rejects a wrong one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.read import read_model
from scripts.experiments.fuzz.record import ALLOWED_FACTOR, SUSPECT_FACTOR, run_motion
from scripts.experiments.fuzz.reference import ReferenceIntegrator
from scripts.experiments.fuzz.reversal import INSTANTS, measure_reversal_error


@pytest.mark.parametrize("formulation", ["reduced", "spf", "dae"])
def test_a_reversed_motion_retraces_its_path(formulation: str) -> None:
    overrides = {
        "formulation": formulation,
        "t_end": 0.6,
        "solver.rtol": 1e-7,
        "solver.output_dt": 0.004,
        "initial": {"q": {"theta_1": -1.0, "theta_3": 1.5}, "q_dot": {"theta_1": 1.0, "theta_3": 3.0}},
        "controller": None,
    }
    motion = Motion(0, "five_bar", "five_bar/swing", overrides)
    record, run = run_motion(motion, thorough=True)
    assert run is not None
    assert (record.verdict, record.fault) == ("done", "")
    assert record.reversal < 30
    reference = ReferenceIntegrator(read_model(run.texts))
    order = [run.coordinates.index(label) for label in reference.model.labels]
    faster = np.where(np.arange(len(run.t)) == len(run.t) - 1 - INSTANTS, 1.01, 1.0)
    other = replace(run, v_tree=run.v_tree * faster[:, None])
    assert measure_reversal_error(other, motion, reference, order, SUSPECT_FACTOR) > ALLOWED_FACTOR
