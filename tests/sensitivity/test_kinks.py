"""Sensitivities through the kinks of torque limits."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin.sensitivity.sensitivities import sensitivities


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_kinks_are_resolved_in_every_formulation(formulation: str) -> None:
    """Step size control includes the sensitivities."""
    names = ["link.link_2.mass", "gravity.y", "joint.theta_2.xyz.x", "controller.K_V", "initial.q_dot.theta_1"]
    overrides = {"t_end": 1.0, "controller.torque_limit": 2.5, "solver.method": "DOP853"}
    tight = {**overrides, "formulation": "dae", "solver.rtol": 1e-13, "solver.max_step": 2e-3}
    expected = sensitivities("five_bar/set_point", names, tight).v_tree
    result = sensitivities("five_bar/set_point", names, {**overrides, "formulation": formulation, "solver.rtol": 1e-8})
    assert np.abs((result.v_tree - expected) / (1.0 + np.abs(expected))).max() <= 1e-5
