"""The five-bar's terms, through Pinocchio and the closure, are those of the appendix, on and off the manifold."""

from __future__ import annotations

import numpy as np

from ckc_pin.dynamics import Terms
from tests.analytic.five_bar import Array, complex_step
from tests.conftest import Pair, assert_close

STATES = 500


def random_states(seed: int) -> list[tuple[Array, Array]]:
    random = np.random.default_rng(seed)
    return [(random.uniform(-np.pi, np.pi, 4), random.uniform(-5, 5, 4)) for _ in range(STATES)]


def regular_states(pair: Pair, seed: int) -> list[tuple[Array, Array]]:
    """States at which phi_z is not nearly singular: rho and what follows from it inherit 1/det phi_z."""
    return [(q, v) for q, v in random_states(seed) if abs(pair[1].s(q)) > 0.1]


def terms_at(pair: Pair, q_tree: Array, v_tree: Array) -> Terms:
    mechanism, _ = pair
    return Terms(mechanism, mechanism.kinematics(q_tree), v_tree)


def assert_equal(ours: Array, theirs: Array, tolerance: float = 1e-12) -> None:
    assert_close(ours, theirs, tolerance, relative=True)


def test_tree_terms_are_eqs_23_to_26(pair: Pair) -> None:
    reference = pair[1]
    for q, v in random_states(0):
        terms = terms_at(pair, q, v)
        assert_equal(terms.D_tree, reference.D_tree(q))
        assert_equal(terms.C_tree, reference.C_tree(q, v))
        assert_equal(terms.h_tree, reference.h_tree(q))
        assert_equal(terms.bias_tree, reference.C_tree(q, v) @ v + reference.h_tree(q))


def test_closure_is_eq_27_sign_included(pair: Pair) -> None:
    reference = pair[1]
    for q, v in random_states(1):
        at = terms_at(pair, q, v).at
        assert_equal(at.phi, reference.phi(q))
        assert_equal(at.phi_q, reference.phi_q(q))
        assert_equal(at.phi_z, reference.phi_z(q))
        assert_equal(at.J_dot(v), reference.J_dot(q, v))


def test_det_phi_z_is_the_sine_between_the_distal_links(pair: Pair) -> None:
    reference = pair[1]
    for q, v in random_states(2):
        determinant = terms_at(pair, q, v).at.phi_z_factor.determinant()
        assert_close(determinant, reference.l[1] * reference.l[3] * reference.s(q), 1e-15)


def test_energy_is_kinetic_and_potential(pair: Pair) -> None:
    for q, v in random_states(3):
        assert_close(terms_at(pair, q, v).energy, pair[1].energy(q, v), 1e-13)


def test_h_tree_is_the_gradient_of_the_potential_energy(pair: Pair) -> None:
    reference = pair[1]
    for q, v in random_states(4)[:50]:
        gradient = complex_step(lambda x: np.array([reference.potential_energy(x)]), q)[0]
        assert_equal(terms_at(pair, q, v).h_tree, gradient)


def test_D_tree_dot_minus_two_C_tree_is_skew(pair: Pair) -> None:
    """Eq. 19 needs it; erratum 1 is about it. D_dot by a complex step on the reference."""
    for q, v in random_states(5):
        D_tree_dot = pair[1].D_tree(q + 1e-200j * v).imag / 1e-200
        C_tree = terms_at(pair, q, v).C_tree
        skew = D_tree_dot - 2 * C_tree
        assert_close(skew, -skew.T, 1e-12 * np.abs(C_tree).max())


def test_D_dot_minus_two_C_is_skew_on_and_off_the_manifold(pair: Pair) -> None:
    """The reduced model's, along v' = rho q_dot."""
    for q, v in regular_states(pair, 6):
        rho = pair[1].rho(q)
        D_dot = pair[1].D(q + 1e-200j * (rho @ v[:2])).imag / 1e-200
        C = terms_at(pair, q, rho @ v[:2]).C
        skew = D_dot - 2 * C
        assert_close(skew, -skew.T, 1e-12 * np.abs(C).max())


def test_rho_and_rho_dot_along_any_velocity(pair: Pair) -> None:
    reference = pair[1]
    for q, v in regular_states(pair, 7):
        terms = terms_at(pair, q, v)
        assert_equal(terms.rho, reference.rho(q))
        assert_equal(terms.rho_dot, reference.rho_dot(q, v))
        assert_equal(terms.rho_dot_times(v[:2]), reference.rho_dot(q, v) @ v[:2])


def test_reduced_terms_are_eq_6(pair: Pair) -> None:
    reference = pair[1]
    for q, v in regular_states(pair, 8):
        terms = terms_at(pair, q, v)
        assert_equal(terms.D, reference.D(q))
        assert_equal(terms.C, reference.C(q, v))
        assert_equal(terms.h, reference.h(q))
        assert_equal(terms.C_times(v[:2]), reference.C(q, v) @ v[:2])


def test_force_of_the_reference_is_that_of_its_terms(pair: Pair) -> None:
    """The reference evaluates D q_ddot + C q_dot + h over the tree for speed."""
    _, reference = pair
    q_tree, q_dot, q_ddot = reference.equilibrium() + 0.1, np.array([1.0, -2.0]), np.array([3.0, 0.5])
    C, h = reference.C(q_tree, reference.rho(q_tree) @ q_dot), reference.h(q_tree)
    assert_close(reference.force(q_tree, q_dot, q_ddot), reference.D(q_tree) @ q_ddot + C @ q_dot + h, 1e-13)
    assert_close(reference.acceleration(q_tree, q_dot, reference.force(q_tree, q_dot, q_ddot)), q_ddot, 1e-12)
