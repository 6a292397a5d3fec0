"""The SPF, eqs. 8, 16 and 17, off its manifold against the numpy five-bar, on it against the reduced model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ckc_pin.dynamics import Terms, reduced_acceleration, spf_terms, spf_z_dot
from ckc_pin.dynamics.formulations import CoriolisVelocity
from tests.analytic.five_bar import FIVE_BAR, Array, E, Z
from tests.conftest import Pair, assert_close
from tests.property.strategies import seeds

epsilons = st.sampled_from([1e-1, 1e-3, 1e-5])


def random_state(seed: int, w: float) -> tuple[Array, Array, Array]:
    """q' at which phi is of size w, q_dot and u; away from singularity."""
    random = np.random.default_rng(seed)
    q_tree = FIVE_BAR.sigma(FIVE_BAR.equilibrium()[[0, 2]] + random.uniform(-0.5, 0.5, 2))
    q_tree[Z] += w * random.uniform(-1, 1, 2)
    return q_tree, random.uniform(-3, 3, 2), random.uniform(-5, 5, 2)


def z_dot(q_tree: Array, q_dot: Array, epsilon: float) -> Array:
    """Second line of eq. 8, in numpy."""
    phi_z, phi_q = FIVE_BAR.phi_z(q_tree), FIVE_BAR.phi_q(q_tree)
    return -np.linalg.solve(phi_z, phi_q @ q_dot + FIVE_BAR.phi(q_tree) / epsilon)


def reference(q_tree: Array, q_dot: Array, u: Array, epsilon: float, convention: CoriolisVelocity) -> Array:
    """q_ddot by the numpy five-bar's D, C, h, C at rho q_dot or at the actual velocity."""
    v_tree = FIVE_BAR.rho(q_tree) @ q_dot
    if convention == "actual":
        v_tree[Z] = z_dot(q_tree, q_dot, epsilon)
    force = u - FIVE_BAR.C(q_tree, v_tree) @ q_dot - FIVE_BAR.h(q_tree)
    return np.linalg.solve(FIVE_BAR.D(q_tree), force)


def ours(pair: Pair, q_tree: Array, q_dot: Array, u: Array, epsilon: float, convention: CoriolisVelocity) -> Array:
    mechanism, _ = pair
    at = mechanism.kinematics(q_tree)
    terms = spf_terms(mechanism, at, q_dot, epsilon, at.phi, convention)
    return reduced_acceleration(terms, E @ u, q_dot if convention == "actual" else None)


@pytest.mark.parametrize("convention", ["rho", "actual"])
@given(seed=seeds, epsilon=epsilons)
def test_spf_terms_use_the_velocity_of_each_convention(
    five_bar: Pair, convention: CoriolisVelocity, seed: int, epsilon: float
) -> None:
    q_tree, q_dot, u = random_state(seed, 0.05)
    expected = reference(q_tree, q_dot, u, epsilon, convention)
    assert_close(ours(five_bar, q_tree, q_dot, u, epsilon, convention), expected, 1e-11, relative=True)


@given(seed=seeds, epsilon=epsilons)
def test_z_dot_is_the_second_line_of_eq_8(five_bar: Pair, seed: int, epsilon: float) -> None:
    q_tree, q_dot, _ = random_state(seed, 0.05)
    at = five_bar[0].kinematics(q_tree)
    assert_close(spf_z_dot(at, q_dot, epsilon, at.phi), z_dot(q_tree, q_dot, epsilon), 1e-12, relative=True)


@given(seed=seeds, epsilon=epsilons)
def test_phi_decays_exponentially_for_any_q_dot(five_bar: Pair, seed: int, epsilon: float) -> None:
    """phi_dot = -phi / epsilon along the actual velocity: eq. 17's second line."""
    q_tree, q_dot, _ = random_state(seed, 0.05)
    at = five_bar[0].kinematics(q_tree)
    terms = spf_terms(five_bar[0], at, q_dot, epsilon, at.phi, "actual")
    assert_close(at.J @ terms.v_tree, -at.phi / epsilon, 1e-12 * max(1, np.abs(terms.v_tree).max()))


@given(seed=seeds)
def test_spf_on_the_manifold_is_the_reduced_model(five_bar: Pair, seed: int) -> None:
    """With w = 0 epsilon and the convention do not matter."""
    mechanism, _ = five_bar
    q_tree, q_dot, u = random_state(seed, 0.0)
    at, zero = mechanism.kinematics(q_tree), np.zeros(2)
    reduced = reduced_acceleration(Terms(mechanism, at, at.rho @ q_dot), E @ u)
    assert_close(reduced, FIVE_BAR.acceleration(q_tree, q_dot, u), 1e-11, relative=True)
    for convention in ("rho", "actual"):
        terms = spf_terms(mechanism, at, q_dot, 1e-6, zero, convention)
        assert_close(reduced_acceleration(terms, E @ u, q_dot), reduced, 1e-11, relative=True)


@given(seed=seeds)
def test_conventions_differ_by_one_over_epsilon_off_the_manifold(five_bar: Pair, seed: int) -> None:
    """From a moving start: what the notes measure not to converge. The difference is linear in 1/epsilon."""
    q_tree, q_dot, u = random_state(seed, 0.05)
    gaps = [
        ours(five_bar, q_tree, q_dot, u, epsilon, "actual") - ours(five_bar, q_tree, q_dot, u, epsilon, "rho")
        for epsilon in (1e-2, 1e-4)
    ]
    assume(np.abs(gaps[0]).max() > 1e-3)
    assert_close(gaps[1], 100 * gaps[0], 1e-9, relative=True)


@given(seed=seeds, epsilon=epsilons)
def test_D_dot_minus_two_C_is_skew_along_the_actual_flow_only(five_bar: Pair, seed: int, epsilon: float) -> None:
    """Eq. 19 along the perturbed flow: with C at the actual velocity, not at rho q_dot."""
    mechanism, _ = five_bar
    q_tree, q_dot, _ = random_state(seed, 0.05)
    at = mechanism.kinematics(q_tree)
    flow = spf_terms(mechanism, at, q_dot, epsilon, at.phi, "actual")
    D_dot = FIVE_BAR.D(q_tree + 1e-200j * flow.v_tree).imag / 1e-200
    skew = D_dot - 2 * flow.C
    assert_close(skew, -skew.T, 1e-11 * np.abs(flow.C).max())
    if np.abs(at.phi).max() > 1e-3 and epsilon < 1e-2:
        other = D_dot - 2 * spf_terms(mechanism, at, q_dot, epsilon, at.phi, "rho").C
        assert np.abs(other + other.T).max() > 1e-6 * np.abs(flow.C).max()
