"""The workspace without second derivatives gives the terms of Pinocchio's own, and allows large mechanisms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ckc_pin import MechanismError, simulate
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.loading import build, load
from ckc_pin.mechanism.library import GeneratorSpec, generate
from ckc_pin.mechanism.tree import FAST
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table

SQUARES, ANGLE, G = 200, 1.2, 9.81


@pytest.mark.parametrize("name", ["delta", "talos", "two_ur5"])
def test_terms_equal_those_of_a_full_workspace(name):
    tree, random = load(name).tree, np.random.default_rng(0)
    for _ in range(3):
        q_tree = tree.integrate(tree.neutral(), random.uniform(-1, 1, tree.n))
        v_tree = random.uniform(-1, 1, tree.n)
        for algorithm in FAST:
            takes_rate = algorithm in (pin.nonLinearEffects, pin.computeCoriolisMatrix)
            state = (q_tree, v_tree) if takes_rate else (q_tree,)
            expected = np.array(algorithm(tree.model, tree.data, *state))
            np.testing.assert_array_equal(tree.evaluate(algorithm, *state), expected)
        D = np.array(pin.crba(tree.model, tree.data, q_tree))
        np.testing.assert_allclose(tree.mass_matrix(q_tree), D, rtol=0, atol=1e-12 * np.abs(D).max())
        pin.computeJointJacobiansTimeVariation(tree.model, tree.data, q_tree, v_tree)
        np.testing.assert_array_equal(tree.jacobian_dot(q_tree, v_tree), tree.data.dJ)
        np.testing.assert_array_equal(tree.kinematics(q_tree)[1], tree.data.J)


@pytest.fixture(scope="module")
def row():
    return build(*generate(GeneratorSpec(generator="n_four_bar", N=SQUARES)))


def test_row_of_many_squares_moves_as_its_closed_form(row):
    """All verticals have one angle: theta_ddot = -k cos(theta), k = g 3 (3 N + 1) / (2 (4 N + 1))."""
    k = G * 3 * (3 * SQUARES + 1) / (2 * (4 * SQUARES + 1))
    run = simulate("n_four_bar", {"mechanism.N": SQUARES, "t_end": 0.5, "solver.rtol": 1e-9})
    theta, rate = run.q_tree[:, 0], run.v_tree[:, 0]
    assert run.status == "done"
    energy = rate**2 / 2 + k * np.sin(theta)
    assert np.ptp(energy) <= 1e-6 * k
    terms = Terms(row, row.assembled, np.zeros(row.n))
    assert len(terms.D_tree) == 2 * SQUARES + 1
    a = _core.Core(core_table(row)).reduced_acceleration(
        row.q_tree, np.zeros(1), np.zeros(row.n), np.zeros(row.n), False
    )
    assert a[0] == pytest.approx(-k * np.cos(row.q_tree[0]), abs=1e-9 * k)


def test_full_workspace_of_a_large_tree_is_refused(row):
    with pytest.raises(MechanismError, match=r"401 coordinates.*more than 325"):
        _ = row.tree.data
