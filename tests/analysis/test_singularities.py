"""Singular configurations against closed forms: elbows that coincide, links in line, dead points of a four-bar."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import InputError, NumericalError
from ckc_pin.analysis.singular_curve import trace_singular
from ckc_pin.analysis.singularities import SingularPoint, SingularSystem, find_singular, search_singular
from scripts.experiments.paper.crossing import cross
from scripts.experiments.paper.singular_claims import loci
from tests.analysis.planar import linkage
from tests.analytic.five_bar import Array, FiveBar
from tests.conftest import Pair, assert_close

TOLERANCE = 1e-8


@pytest.fixture(scope="module")
def singular(pair: Pair) -> list[SingularPoint]:
    """Singular configurations of a five-bar from random starts."""
    return search_singular(pair[0], 30)


def elbows(model: FiveBar, q_tree: Array) -> Array:
    """Return the vector (..., 2) from the left to the right elbow, from lengths and angles only."""
    one, three = q_tree[..., 0], q_tree[..., 2]
    x = model.base + model.l[2] * np.cos(three) - model.l[0] * np.cos(one)
    return np.stack([x, model.l[2] * np.sin(three) - model.l[0] * np.sin(one)], axis=-1)


def coincident_elbows(model: FiveBar) -> Array:
    """Return the angles at which the elbows coincide above the base: the apex of a triangle."""
    l1, l3, base = model.l[0], model.l[2], model.base
    x = (base**2 + l1**2 - l3**2) / (2 * base)
    y = np.sqrt(l1**2 - x**2)
    return np.array([np.arctan2(y, x), np.arctan2(y, x - base)])


def wrap(angle: Array) -> Array:
    return np.angle(np.exp(1j * angle))


def test_locked_points_are_the_two_type_1_points(five_bar: Pair) -> None:
    mechanism, model = five_bar
    apex = coincident_elbows(model)
    assert_close(apex, [0.993865, 2.147728], 1e-6)
    locked = [p for p in search_singular(mechanism, 30) if p.kind == "locked"]
    q = wrap(np.array([p.at.q_tree[[0, 2]] for p in locked]))
    assert {tuple(sign) for sign in np.sign(q)} == {(1.0, 1.0), (-1.0, -1.0)}
    assert_close(np.abs(q), np.broadcast_to(apex, q.shape), TOLERANCE)
    assert_close(np.array([p.fold for p in locked]), 0.0, TOLERANCE)


def test_singular_points_satisfy_the_closed_form(pair: Pair, singular: list[SingularPoint]) -> None:
    _, model = pair
    l2, l4 = model.l[1], model.l[3]
    for point in singular:
        q_tree = point.at.q_tree
        assert_close(model.phi(q_tree), 0.0, TOLERANCE)
        assert_close(model.phi_z(q_tree) @ point.null[[1, 3]], 0.0, TOLERANCE)
        assert_close(model.s(q_tree), 0.0, TOLERANCE)
        distance = np.linalg.norm(elbows(model, q_tree))
        assert min(abs(distance - l2 - l4), abs(distance - abs(l2 - l4))) < TOLERANCE
        # y . d2phi[v, v] of two circles that touch from outside or from inside
        touching = l4 if distance > l2 else -l4
        assert_close(abs(point.fold), l2 * l4 * abs(l2 + touching) / (l2**2 + l4**2), TOLERANCE)


def test_links_of_different_lengths_are_never_locked(pair: Pair, singular: list[SingularPoint]) -> None:
    _, model = pair
    kinds = {p.kind for p in singular}
    assert kinds == ({"locked", "fold"} if model.l[1] == model.l[3] else {"fold"})


def test_rank_of_J_and_freedoms_are_kept_at_singular_phi_z(pair: Pair, singular: list[SingularPoint]) -> None:
    mechanism, model = pair
    for point in singular:
        values = np.linalg.svd(model.J(point.at.q_tree), compute_uv=False)
        assert_close(point.sigma_min_J, values[-1], 1e-12)
        assert values[-1] > 0.19
        assert point.rank_J == point.freedoms == 2
        assert point.q_rank == 1
        others = [k for k, name in enumerate(mechanism.coordinates) if name not in point.chart]
        smallest = np.linalg.svd(model.J(point.at.q_tree)[:, others], compute_uv=False)[-1]
        assert_close(point.chart_sigma_min, smallest, 1e-12)
        assert smallest > 0.1


def test_type_2_is_a_closed_curve(pair: Pair, singular: list[SingularPoint]) -> None:
    mechanism, model = pair
    reach = model.l[1] + model.l[3]
    stretched = next(p for p in singular if np.linalg.norm(elbows(model, p.at.q_tree)) > 0.5)
    curve = trace_singular(mechanism, stretched)
    assert curve.closed
    assert_close(np.linalg.norm(elbows(model, curve.q_tree), axis=1), reach, TOLERANCE)
    # the curve is complete: closed around the unreachable region, with small steps
    q = curve.q_tree[:, [0, 2]]
    assert_close(wrap(q[-1] - q[0]), 0.0, TOLERANCE)
    assert np.abs(wrap(np.diff(q, axis=0))).max() < 0.1
    theta_3 = np.linspace(-np.pi, np.pi, 2001)
    rim = [t for t in theta_3 if _is_out_of_reach(model, t, reach)]
    assert_close(np.ptp(curve.q_tree[:, 2]), np.ptp(rim), 0.02)


def _is_out_of_reach(model: FiveBar, theta_3: float, reach: float) -> bool:
    """Whether some theta_1 moves the elbows farther apart than the links reach at this theta_3."""
    right = np.array([model.base + model.l[2] * np.cos(theta_3), model.l[2] * np.sin(theta_3)])
    return bool(np.linalg.norm(right) + model.l[0] > reach)


def test_type_1_is_a_circle_of_configurations_over_one_point(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    locked = next(p for p in search_singular(mechanism, 30) if p.kind == "locked")
    curve = trace_singular(mechanism, locked)
    assert curve.closed
    assert_close(np.ptp(curve.q_tree[:, [0, 2]], axis=0), 0.0, TOLERANCE)
    assert_close(np.abs(wrap(np.diff(curve.q_tree[:, 1]))).sum(), 2 * np.pi, TOLERANCE)


def test_loci_of_both_five_bars(pair: Pair) -> None:
    mechanism, model = pair
    names = [locus.name for locus in loci(mechanism, 30)]
    small = "type 1" if model.l[1] == model.l[3] else "type 1, opened"
    assert sorted(names) == [small, small, "type 2"]


def test_serial_singularities_stretch_or_fold_a_chain(pair: Pair) -> None:
    mechanism, _ = pair
    for point in search_singular(mechanism, 4, point="tip"):
        q_tree = point.at.q_tree
        assert point.kind == "serial"
        assert np.isnan(point.fold)
        assert_close(np.sin(q_tree[[1, 3]]).prod(), 0.0, TOLERANCE)
        curve = trace_singular(mechanism, point, point="tip")
        assert curve.closed
        assert_close(np.sin(curve.q_tree[:, [1, 3]]).prod(axis=1), 0.0, TOLERANCE)


def test_jacobian_equals_finite_differences_of_the_residual(pair: Pair) -> None:
    mechanism, _ = pair
    random = np.random.default_rng(1)
    for point in (None, "tip"):
        system = SingularSystem(mechanism, point)
        at, v = mechanism.kinematics(random.uniform(-1, 1, 4)), random.uniform(-1, 1, 4)
        h, columns = 1e-6, []
        for step in h * np.eye(8):
            after, before = (
                system.residual(at.integrate(sign * step[:4]), v + sign * step[4:]) for sign in (1.0, -1.0)
            )
            columns.append((after - before) / (2 * h))
        assert_close(system.jacobian(at, v), np.array(columns).T, 1e-8)


def test_four_bar_turns_back_where_crank_and_coupler_are_in_line() -> None:
    """A crank-rocker driven by its rocker: the rocker turns back at |l1 - l2| and at l1 + l2."""
    base, crank, coupler, rocker = 0.4, 0.1, 0.35, 0.3
    mechanism = linkage([(0.0, [crank, coupler]), (base, [rocker])], [1.0, -0.5, 2.0], ["b1"])
    assert mechanism.d == 1
    cosines = [(base**2 + rocker**2 - x**2) / (2 * base * rocker) for x in (coupler - crank, coupler + crank)]
    limits = np.pi - np.arccos(cosines)
    points = search_singular(mechanism, 20)
    reached = np.unique(np.round(np.abs(wrap(np.array([p.at.q_tree[2] for p in points]))), 7))
    assert_close(reached, np.sort(limits), 1e-7)
    for point in points:
        assert point.kind == "fold"
        assert point.freedoms == 1
        assert_close(np.abs(wrap(point.at.q_tree[2])) - limits[np.argmin(
            np.abs(np.abs(wrap(point.at.q_tree[2])) - limits))], 0.0, TOLERANCE)  # fmt: skip
    with pytest.raises(InputError, match="d = 1"):
        trace_singular(mechanism, points[0])


def test_flat_parallelogram_gains_a_freedom() -> None:
    mechanism = linkage([(0.0, [0.2, 0.5]), (0.5, [0.2])], [1.0, -1.0, 1.0], ["a1"])
    flat = find_singular(mechanism, np.array([0.05, -0.06, 0.07]))
    assert flat.kind == "rank loss"
    assert (flat.rank_J, flat.freedoms, mechanism.d) == (1, 2, 1)
    assert_close(flat.at.q_tree, 0.0, 1e-5)  # a double root of phi limits the accuracy


def test_redundant_rows_do_not_change_singular_points(five_bar: Pair) -> None:
    """The same five-bar with point instead of point_2d, whose third row is redundant."""
    _, model = five_bar
    l1, l2, l3, l4 = model.l
    chains = [(0.0, [l1, l2]), (model.base, [l3, l4])]
    mechanism = linkage(chains, [-1.434, 0.248, -1.707, -0.248], ["a1", "b1"], loop="point")
    assert mechanism.closure.rows == 3
    points = search_singular(mechanism, 15)
    assert {p.kind for p in points} == {"locked", "fold"}
    for point in points:
        assert_close(model.s(point.at.q_tree), 0.0, TOLERANCE)
        assert (point.rank_J, point.freedoms) == (2, 2)


def test_singular_surfaces_are_sampled_for_three_freedoms() -> None:
    """Chains of three and two links: phi_z is singular where the two links of z are in line."""
    chains = [(0.0, [0.3, 0.3, 0.2]), (0.4, [0.3, 0.3])]
    mechanism = linkage(chains, [2.2, -1.0, -0.8, 1.0, 0.9], ["a1", "a2", "b1"])
    assert mechanism.d == 3
    points = search_singular(mechanism, 10)
    assert len(points) > 5
    for point in points:
        angle_a, angle_b = point.at.q_tree[:3].sum(), point.at.q_tree[3:].sum()
        assert_close(np.sin(angle_a - angle_b), 0.0, TOLERANCE)
    with pytest.raises(InputError, match="search_singular"):
        trace_singular(mechanism, points[0])


def test_dae_passes_through_type_2(pair: Pair, singular: list[SingularPoint]) -> None:
    mechanism, model = pair
    for point in singular[:4]:
        crossing = cross(mechanism, point)
        assert crossing.changes_sign
        assert crossing.returned < 1e-9
        assert crossing.energy_drift < 1e-9
        assert crossing.sigma_min_J.min() > 0.15
        assert np.abs(crossing.det_phi_z).min() < 1e-9
        assert np.abs(crossing.det_phi_z).max() <= model.l[1] * model.l[3]


def test_invalid_arguments_are_named(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    with pytest.raises(InputError, match="there are tip"):
        find_singular(mechanism, point="elbow")
    with pytest.raises(InputError, match="expected 4 finite numbers"):
        find_singular(mechanism, np.zeros(3))
    point = find_singular(mechanism)
    with pytest.raises(InputError, match="step = 0"):
        trace_singular(mechanism, point, step=0.0)


def test_regular_mechanism_has_no_singular_point() -> None:
    """In a four-bar with q = crank, coupler and rocker are never in line (Grashof), so phi_z is regular everywhere."""
    mechanism = linkage([(0.0, [0.1, 0.35]), (0.4, [0.3])], [1.0, -0.5, 2.0], ["a1"])
    assert search_singular(mechanism, 10) == []
    with pytest.raises(NumericalError, match="no singular configuration"):
        find_singular(mechanism)
