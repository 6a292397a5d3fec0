"""Properties of the terms and formulations of random spatial mechanisms with all types of loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ckc_pin.dynamics import Terms, dae_acceleration, h_gradient, multipliers, reduced_acceleration, tangent_basis
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Kinematics
from ckc_pin.mechanism.configuration import Partition
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.property.mechanisms import ROTORS, Closed, closed_mechanism, differentiate_along
from tests.property.strategies import TYPES, angles, seeds
from tests.property.worlds import rotation, slope

every_mechanism = st.builds(
    closed_mechanism, st.sampled_from(TYPES), seeds, free=st.booleans(), redundant=st.booleans()
).filter(lambda closed: closed.regular)
many = settings(max_examples=25)


@many
@given(every_mechanism)
def test_energy_is_the_sum_over_bodies(closed: Closed) -> None:
    """1/2 v D' v + V equals a sum over bodies placed with NumPy, and over rotors."""
    mechanism, world = closed.mechanism, closed.world
    q, v = world.configuration(), world.velocity()
    q_tree, v_tree = (np.array([x[name] for name in mechanism.coordinates]) for x in (q, v))
    terms = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(q_tree)), v_tree)
    rotors = sum((spec.armature or 0.0) * v[spec.name] ** 2 / 2 for spec in ROTORS)
    assert_close(terms.energy - mechanism.springs.energy(terms.q_tree), world.energy(q, v) + rotors, 1e-9)


@many
@given(every_mechanism)
def test_rho_spans_the_null_space_of_J(closed: Closed) -> None:
    mechanism, at = closed.mechanism, closed.random_state().at
    rank = np.linalg.matrix_rank(at.J, tol=1e-8)
    assert at.rho.shape == (mechanism.n, mechanism.n - rank)
    assert_close(at.rho[mechanism.partition.q], np.eye(mechanism.d), 0)
    assert_close(at.J @ at.rho, 0, 1e-12 * np.abs(at.rho).max())


@many
@given(every_mechanism)
def test_sigma_closes_the_loops_at_q(closed: Closed) -> None:
    at = closed.random_state().at
    again = sigma(closed.mechanism, closed.mechanism.independent_part(at.q_tree))
    assert again.verdict == "converged"
    assert_close(at.phi, 0, closed.mechanism.tolerance)
    assert_close(closed.mechanism.tree.difference(again.at.q_tree, at.q_tree), 0, 1e-11)


@many
@given(every_mechanism)
def test_rho_dot_is_the_derivative_of_rho(closed: Closed) -> None:
    terms = closed.random_state()
    step = 2e-4 / np.sqrt(max(1, np.abs(terms.at.rho).max()))  # rho varies quickly where it is large
    rho_dot = differentiate_along(
        closed.mechanism, terms.q_tree, terms.v_tree, lambda q: closed.mechanism.kinematics(q).rho, step
    )
    assert_close(terms.rho_dot, rho_dot, 1e-8 * max(1, np.abs(rho_dot).max()))
    assert_close(terms.rho_dot_times(terms.q_dot), terms.rho_dot @ terms.q_dot, 1e-12 * max(1, np.abs(rho_dot).max()))


@many
@given(every_mechanism)
def test_D_dot_minus_two_C_is_skew(closed: Closed) -> None:
    """Eq. 19 uses this property."""
    terms, mechanism = closed.random_state(), closed.mechanism

    def D(q_tree: Array) -> Array:
        return Terms(mechanism, mechanism.kinematics(q_tree), terms.v_tree).D

    skew = differentiate_along(mechanism, terms.q_tree, terms.v_tree, D) - 2 * terms.C
    assert_close(skew, -skew.T, 1e-8 * max(1, np.abs(terms.C).max()))
    assert_close(terms.C_times(terms.q_dot), terms.C @ terms.q_dot, 1e-12 * max(1, np.abs(terms.C).max()))


@many
@given(every_mechanism)
def test_D_is_symmetric_positive_definite(closed: Closed) -> None:
    terms = closed.random_state()
    assert_close(terms.D, terms.D.T, 1e-13, relative=True)
    assert np.linalg.eigvalsh(terms.D)[0] > 0


@many
@given(every_mechanism)
def test_bias_is_C_v_plus_h(closed: Closed) -> None:
    terms = closed.random_state()
    assert_close(terms.bias_tree, terms.C_tree @ terms.v_tree + terms.h_tree, 1e-11)


@many
@given(every_mechanism)
def test_h_is_the_gradient_of_the_potential(closed: Closed) -> None:
    """For gravity and springs, in the direction of each column of rho."""
    terms, mechanism = closed.random_state(), closed.mechanism

    def V(q_tree: Array) -> Array:
        return np.array(Terms(mechanism, mechanism.kinematics(q_tree), terms.v_tree).potential_energy)

    slopes = [differentiate_along(mechanism, terms.q_tree, column, V) for column in terms.rho.T]
    assert_close(terms.h, slopes, 1e-9 * max(1, np.abs(terms.h).max()))


@many
@given(every_mechanism)
def test_dae_is_the_reduced_model(closed: Closed) -> None:
    """J a + J_dot v = 0, and a = rho q_ddot + rho_dot q_dot with eq. 6's q_ddot."""
    terms, u_tree = closed.random_state(), closed.u_tree()
    a = dae_acceleration(terms, u_tree)
    size = max(1, np.abs(a).max())
    assert_close(terms.at.J @ a + terms.J_dot @ terms.v_tree, 0, 1e-12 * size)
    q_ddot = reduced_acceleration(terms, u_tree)
    assert_close(a, terms.rho @ q_ddot + terms.rho_dot @ terms.q_dot, 1e-11 * size)


@many
@given(every_mechanism)
def test_eq_6_with_and_without_C_agree_on_the_manifold(closed: Closed) -> None:
    """Without the matrix C', and with it at a given q_dot."""
    terms, u_tree = closed.random_state(), closed.u_tree()
    q_ddot = reduced_acceleration(terms, u_tree)
    assert_close(reduced_acceleration(terms, u_tree, terms.q_dot), q_ddot, 1e-11 * max(1, np.abs(q_ddot).max()))


@many
@given(every_mechanism)
def test_multipliers_satisfy_eq_1(closed: Closed) -> None:
    terms, u_tree = closed.random_state(), closed.u_tree()
    a = dae_acceleration(terms, u_tree)
    force = terms.at.J.T @ multipliers(terms, u_tree, a)
    forces = terms.D_tree @ a + terms.C_tree @ terms.v_tree + terms.h_tree
    assert_close(forces, u_tree + terms.damping_force + force, 1e-11 * max(1, np.abs(forces).max()))


@many
@given(every_mechanism)
def test_energy_changes_by_the_power_of_actuators_and_dampers(closed: Closed) -> None:
    """Loops do no work."""
    terms, u_tree, mechanism = closed.random_state(), closed.u_tree(), closed.mechanism
    a = dae_acceleration(terms, u_tree)

    def energy(t: float) -> Array:
        q_tree = mechanism.tree.integrate(terms.q_tree, t * terms.v_tree)
        return np.array(Terms(mechanism, mechanism.kinematics(q_tree), terms.v_tree + t * a).energy)

    power = terms.v_tree @ (u_tree + terms.damping_force)
    assert_close(slope(energy), power, 1e-9 * max(1, abs(power), np.abs(a).max()))


@many
@given(every_mechanism)
def test_dampers_dissipate(closed: Closed) -> None:
    terms = closed.random_state()
    assert terms.v_tree @ terms.damping_force < 0


@many
@given(every_mechanism)
def test_the_motion_does_not_depend_on_the_choice_of_q(closed: Closed) -> None:
    """Any regular partition gives the same tree acceleration, and D congruent by d q_other / d q."""
    terms, u_tree, mechanism = closed.random_state(), closed.u_tree(), closed.mechanism
    assume(np.abs(terms.rho[mechanism.partition.z]).max() > 0.2)  # otherwise no other coordinate can be independent
    other = other_partition(terms.at)
    at = Kinematics(mechanism.tree, mechanism.closure, other, terms.q_tree)
    theirs = Terms(mechanism, at, terms.v_tree)
    change = terms.rho[other.q]  # d q_other / d q
    assert_close(terms.D, change.T @ theirs.D @ change, 1e-12, relative=True)
    assert_close(terms.h, change.T @ theirs.h, 1e-12 * max(1, np.abs(terms.h).max()))
    a, b = (t.rho @ reduced_acceleration(t, u_tree) + t.rho_dot @ t.q_dot for t in (terms, theirs))
    assert_close(a, b, 1e-11 * max(1, np.abs(a).max()))


def other_partition(at: Kinematics) -> Partition:
    """Return a partition with one independent and one dependent coordinate exchanged, the most regular one."""
    q, z, rho_z = at.partition.q.copy(), at.partition.z.copy(), np.abs(at.rho[at.partition.z])
    row, column = np.unravel_index(np.argmin(np.abs(np.log(np.maximum(rho_z, 1e-300)))), rho_z.shape)
    q[column], z[row] = z[row], q[column]
    return Partition(q, z)


@given(kind=st.sampled_from(TYPES), seed=seeds, rpy=angles, free=st.booleans())
def test_dynamics_do_not_depend_on_the_orientation_of_the_world(
    kind: str, seed: int, rpy: tuple[float, float, float], free: bool
) -> None:
    """A rotation of everything, gravity included, does not change phi and J in frame A's axes, D', C', h' or motion."""
    one = closed_mechanism(kind, seed, free=free)  # type: ignore[arg-type]
    assume(one.regular)
    two = closed_mechanism(kind, seed, free=free, turn=rotation(np.array(rpy)))  # type: ignore[arg-type]
    ours = one.random_state()
    theirs = Terms(two.mechanism, two.mechanism.kinematics(ours.q_tree), ours.v_tree)
    u_tree = one.u_tree()
    for name in ("D_tree", "C_tree", "h_tree", "J_dot", "energy"):
        assert_close(getattr(ours, name), getattr(theirs, name), 1e-12 * max(1, np.abs(getattr(ours, name)).max()))
    assert_close(ours.at.phi, theirs.at.phi, 1e-12)
    assert_close(ours.at.J, theirs.at.J, 1e-12)
    a = dae_acceleration(ours, u_tree)
    assert_close(a, dae_acceleration(theirs, u_tree), 1e-11 * max(1, np.abs(a).max()))


@many
@given(every_mechanism)
def test_tangent_basis_spans_the_null_space_of_J(closed: Closed) -> None:
    """Each basis vector has one freedom and no large entry; the particular solution satisfies J x = -J_dot v."""
    terms = closed.random_state()
    tangent, particular = tangent_basis(terms, terms.J_dot @ terms.v_tree)
    free = [
        int(np.flatnonzero((tangent == np.eye(closed.mechanism.d)[k]).all(axis=1))[0])
        for k in range(closed.mechanism.d)
    ]
    assert len(set(free)) == closed.mechanism.d
    assert np.abs(tangent).max() < 10
    assert not particular[free].any()
    assert_close(terms.at.J @ tangent, 0, 1e-12)
    drift = terms.J_dot @ terms.v_tree
    assert_close(terms.at.J @ particular, -drift, 1e-12 * max(1, np.abs(drift).max()))


@settings(max_examples=30)
@given(every_mechanism.filter(lambda closed: not closed.world.free))
def test_h_gradient_is_the_hessian_of_the_potential_in_q(closed: Closed) -> None:
    mechanism, at = closed.mechanism, closed.random_state().at
    q = mechanism.independent_part(at.q_tree)

    def h(x: Array) -> Array:
        computed = sigma(mechanism, x, at)
        assert computed.verdict == "converged"
        return Terms(mechanism, computed.at, np.zeros(mechanism.n)).h

    hessian = h_gradient(mechanism, at)
    slopes = np.array([slope(lambda t, e=e: h(q + t * e)) for e in np.eye(mechanism.d)]).T
    assert_close(hessian, slopes, 1e-6 * max(1, np.abs(slopes).max()))
    assert_close(hessian, hessian.T, 1e-12 * max(1, np.abs(hessian).max()))


@pytest.mark.parametrize("redundant", [False, True])
def test_rows_of_a_loop_closed_twice_are_redundant(redundant: bool) -> None:
    """The number of freedoms does not change, and all rows of the second loop are redundant."""
    closed = closed_mechanism("hinge", 1, redundant=redundant)
    assert (closed.mechanism.d, closed.mechanism.rank) == (14 - 6, 6)
    assert len(closed.mechanism.redundant) == (5 if redundant else 0)
