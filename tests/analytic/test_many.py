"""A closure at many configurations at once, against the same one at a time."""

import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.kinematics.extended import extend_closure
from ckc_pin.mechanism.batch import evaluate_closure, integrate_many, join_closures
from tests.conftest import assert_close

MECHANISMS = ["five_bar", "delta", "three_rrr", "stewart", "andrews", "bricard", "two_ur5", "slider_crank_spatial"]


@pytest.mark.parametrize("name", MECHANISMS)
def test_batch_evaluation_equals_single_configurations(name):
    mechanism = load(name)
    random = np.random.default_rng(3)
    steps = random.uniform(-1.0, 1.0, (20, mechanism.n))
    q_tree = integrate_many(mechanism.tree, np.tile(mechanism.q_tree, (20, 1)), steps)
    twice = join_closures(mechanism.closure, mechanism.closure)
    phi, J = evaluate_closure(mechanism.tree, twice, q_tree)
    for k, step in enumerate(steps):
        at = mechanism.kinematics(mechanism.tree.integrate(mechanism.q_tree, step))
        assert_close(phi[k], np.tile(at.phi, 2), 1e-13)
        assert_close(J[k], np.vstack([at.J, at.J]), 1e-13)


@pytest.mark.parametrize("name", ["five_bar", "delta", "three_rrr", "stewart"])
def test_extended_rows_are_coordinates_and_position_of_the_point(name):
    mechanism = load(name)
    point = next(iter(mechanism.points))
    extended = extend_closure(mechanism, point)
    phi, _ = evaluate_closure(mechanism.tree, extended.closure, mechanism.q_tree[None])
    assert_close(phi[0, extended.joints], mechanism.independent_part(mechanism.q_tree), 0.0)
    assert_close(phi[0, extended.place[:3]], mechanism.point_positions(mechanism.q_tree)[point], 1e-15)
    assert_close(phi[0, extended.place[3:]], np.zeros(len(extended.place) - 3), 1e-12)
    assert len(extended.fixing) == mechanism.d
