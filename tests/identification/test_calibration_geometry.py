"""Derivatives of loops and points with respect to parameters, against differences of rebuilt mechanisms."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin
from ckc_pin.identification.calibration_geometry import Geometry
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.parameters import values_of, with_components

STEP = 1e-5
CASES = {
    "five_bar": ["joint.theta_4.xyz.x", "joint.tip_left_fixed.rpy.z", "loop.elbow.frame_b.xyz.y"],
    "delta": ["joint.swing_2a.xyz.x", "joint.tilt_1b.rpy.y", "loop.ball_3a.frame_b.xyz.z"],
    "two_ur5": ["loop.left_grip.frame_b.rpy.x", "loop.right_grip.frame_a.xyz.y", "joint.left_elbow_joint.rpy.z"],
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_rebuilt_mechanisms(name: str) -> None:
    nominal, random = ckc_pin.load(name), np.random.default_rng(0)
    values = with_components(values_of(nominal.spec, nominal.urdf))
    parameters = [x for x in CASES[name] if x in values]
    assert parameters == CASES[name]
    tree = nominal.tree
    q_tree = np.array([tree.integrate(nominal.q_tree, 0.3 * random.standard_normal(nominal.n)) for _ in range(4)])
    geometry = Geometry(nominal, parameters)
    by_phi, by_point = geometry.parameter_derivatives(q_tree)
    for k, parameter in enumerate(parameters):
        sides = [ckc_pin.load(name, {parameter: float(values[parameter]) + h}) for h in (STEP, -STEP)]  # type: ignore[arg-type]
        phi = [evaluate_closure(x.tree, x.closure, q_tree)[0] for x in sides]
        points = [[list(x.point_positions(q).values()) for q in q_tree] for x in sides]
        assert np.abs((phi[0] - phi[1]) / (2 * STEP) - by_phi[..., k]).max() < 1e-8
        assert np.abs(np.subtract(*points) / (2 * STEP) - by_point[..., k]).max(initial=0.0) < 1e-8
        geometry.set_values(geometry.values + STEP * (np.arange(3) == k))
        assert np.abs(geometry.evaluate(q_tree)[0] - phi[0]).max() < 1e-14
        geometry.set_values(geometry.values - STEP * (np.arange(3) == k))
