"""Springs: force and stiffness are the derivatives of the energy; dampers pull against the motion. Off the manifold."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.property.mechanisms import Closed, closed_mechanism, differentiate_along
from tests.property.strategies import seeds
from tests.property.worlds import World, slope

worlds = st.builds(closed_mechanism, st.just("point"), seeds, free=st.booleans())
many = settings(max_examples=25)


def anywhere(closed: Closed) -> tuple[Array, Array]:
    """A configuration and a velocity that know nothing of the loops."""
    mechanism, world = closed.mechanism, closed.world
    q, v = (np.array([x[name] for name in mechanism.coordinates]) for x in (world.configuration(), world.velocity()))
    return mechanism.tree.from_coordinates(q), v


def lengths(world: World, q: dict[str, float]) -> tuple[float, float]:
    """Of the two springs between frames, as `mechanisms.SPRINGS` has them."""
    (_, p_a), (R_b, p_b), (_, p_3) = (world.placement(name, q) for name in ("a_4", "b_4", "b_3"))
    return float(np.linalg.norm(p_a - p_b - R_b @ [0.1, 0.2, 0.3])), float(np.linalg.norm(p_3))


@many
@given(worlds)
def test_spring_energy_matches_lengths(closed: Closed) -> None:
    q = closed.world.configuration()
    q_tree = closed.mechanism.tree.from_coordinates(np.array([q[name] for name in closed.mechanism.coordinates]))
    first, second = lengths(closed.world, q)
    joints = 5.0 * (q["a_j4"] - 0.3) ** 2 + 20.0 * (q["b_j2"] + 0.1) ** 2
    energy = (joints + 30.0 * (first - 0.5) ** 2 + 10.0 * (second - 0.2) ** 2) / 2
    assert_close(closed.mechanism.springs.energy(q_tree), energy, 1e-12 * max(1, energy))


@many
@given(worlds)
def test_elastic_force_is_minus_the_gradient_of_energy(closed: Closed) -> None:
    q_tree, _ = anywhere(closed)
    springs, mechanism = closed.mechanism.springs, closed.mechanism
    gradient = [
        differentiate_along(mechanism, q_tree, e, lambda q: np.array(springs.energy(q))) for e in np.eye(mechanism.n)
    ]
    assert_close(springs.elastic_force(q_tree), -np.array(gradient), 1e-8)


@many
@given(worlds)
def test_elastic_gradient_is_minus_the_slope_of_the_force(closed: Closed) -> None:
    """Along the tangent coordinates, a free root's included."""
    q_tree, _ = anywhere(closed)
    springs, mechanism = closed.mechanism.springs, closed.mechanism
    slopes = np.array([differentiate_along(mechanism, q_tree, e, springs.elastic_force) for e in np.eye(mechanism.n)]).T
    assert_close(springs.elastic_gradient(q_tree), -slopes, 1e-8)


@many
@given(worlds)
def test_damping_power_matches_elongation_rates(closed: Closed) -> None:
    """-damping * rate^2, summed."""
    world, mechanism = closed.world, closed.mechanism
    q, v = world.configuration(), world.velocity()
    q_tree, v_tree = (np.array([x[name] for name in mechanism.coordinates]) for x in (q, v))
    rate = slope(lambda t: np.array(lengths(world, world.moved(q, v, t))[1]))
    force = mechanism.springs.damping_force(mechanism.tree.from_coordinates(q_tree), v_tree)
    assert_close(v_tree @ force, -0.2 * v["a_j4"] ** 2 - 1.5 * rate**2, 1e-9)
