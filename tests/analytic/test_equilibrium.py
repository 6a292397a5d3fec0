"""The hanging equilibrium to the digits of the notes, and the Hessian of the potential."""

from __future__ import annotations

import numpy as np

from ckc_pin.dynamics import Terms, h_gradient, stable_equilibrium
from tests.analytic.five_bar import Array
from tests.conftest import Pair, assert_close

# angles, det phi_z, potential energy: eight digits, computed apart from this program
FIGURES = {
    "five_bar": ([-1.43430851, 0.24818928, -1.70733217, -0.24812529], 0.06462893, -2.81316369),
    "five_bar_as_printed": ([-1.43441728, 0.25009340, -1.71330920, -0.25683802], 0.06024360, -2.80113016),
}


def test_equilibrium(pair: Pair) -> None:
    mechanism, reference = pair
    at = stable_equilibrium(mechanism)
    angles, determinant, energy = FIGURES[mechanism.name]
    assert_close(at.q_tree, angles, 5.1e-9)
    assert_close(at.q_tree, reference.equilibrium(), 1e-12)
    assert_close(at.phi_z_factor.determinant(), determinant, 5.1e-9)
    assert_close(Terms(mechanism, at, np.zeros(4)).potential_energy, energy, 5.1e-9)


def test_h_gradient_is_the_slope_of_h_along_sigma(pair: Pair) -> None:
    """Against differences of order 4 of the reference's h on its closed-form sigma."""
    mechanism, reference = pair
    random, step = np.random.default_rng(0), 2e-4
    checked = 0
    while checked < 50:
        q = random.uniform(-np.pi, np.pi, 2)
        try:
            q_tree = reference.sigma(q)
        except ValueError:
            continue
        if abs(reference.s(q_tree)) < 0.5:  # h grows like 1/s^3 towards singularity, its differences' error like 1/s^11
            continue
        checked += 1

        def h(x: Array) -> Array:
            return reference.h(reference.sigma(x))

        slope = np.array(
            [(8 * (h(q + e) - h(q - e)) - h(q + 2 * e) + h(q - 2 * e)) / (12 * step) for e in step * np.eye(2)]
        ).T
        hessian = h_gradient(mechanism, mechanism.kinematics(q_tree))
        assert_close(hessian, slope, 1e-8, relative=True)
        assert_close(hessian, hessian.T, 1e-12, relative=True)


def test_equilibrium_is_stable(pair: Pair) -> None:
    mechanism, _ = pair
    assert np.linalg.eigvalsh(h_gradient(mechanism, stable_equilibrium(mechanism)))[0] > 0
