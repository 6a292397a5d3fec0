"""Psi of eq. 3, and sigma of eq. 4 against the intersection of two circles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ckc_pin import Mechanism
from ckc_pin.kinematics.sigma import follow_sigma, newton, sigma
from ckc_pin.mechanism import Psi
from tests.analytic.five_bar import Array, FiveBar, Q, complex_step
from tests.conftest import Pair, assert_close

TYPE_1 = np.array([0.993865, 2.147728])  # coincident elbows on `five_bar`, six digits


def elbow_distance(reference: FiveBar, q: Array) -> float:
    left, right = (reference.l[k] * np.exp(1j * angle) for k, angle in zip((0, 2), q, strict=True))
    return abs(right + reference.base - left)


def random_q(seed: int, count: int) -> Array:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 2))


def turned(angles: Array) -> Array:
    """Angles within (-pi, pi]: sigma follows joints over whole turns, circles do not."""
    return np.angle(np.exp(1j * angles))


def test_psi_stacks_phi_and_q(pair: Pair) -> None:
    mechanism, reference = pair
    for q_tree in np.random.default_rng(0).uniform(-np.pi, np.pi, (100, 4)):
        q = np.array([0.3, -0.2])
        psi = Psi(mechanism.kinematics(q_tree))
        assert_close(psi.value(q), [*reference.phi(q_tree), *(q_tree[Q] - q)], 1e-14)
        slope = complex_step(lambda x: np.concatenate([reference.phi(x), x[Q]]), q_tree)
        assert_close(psi.jacobian, slope, 1e-14)


def test_rho_is_eq_5(pair: Pair) -> None:
    """rho = -(d Psi / d q')^-1 d Psi / d q, the square system as the paper writes it."""
    mechanism, reference = pair
    for q_tree in np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 4)):
        if abs(reference.s(q_tree)) < 0.1:
            continue
        at = mechanism.kinematics(q_tree)
        rho = -np.linalg.solve(Psi(at).jacobian, np.vstack([np.zeros((2, 2)), -np.eye(2)]))
        assert_close(at.rho, rho, 1e-12, relative=True)


def test_sigma_equals_two_circle_intersection_on_the_start_branch(pair: Pair) -> None:
    """Wherever the circles meet, over the whole torus of q: det phi_z > 0 everywhere, as assembled."""
    mechanism, reference = pair
    nearest, reach = abs(reference.l[1] - reference.l[3]), reference.l[1] + reference.l[3]
    for q in random_q(2, 200):
        if nearest + 1e-3 < elbow_distance(reference, q) < reach - 1e-3:
            solution = sigma(mechanism, q)
            assert solution.verdict == "converged", f"sigma({q}): {solution.reason}"
            assert_close(turned(solution.at.q_tree - reference.sigma(q)), 0, 1e-11)
            assert_close(solution.at.q_tree[Q], q, 1e-14)
            assert_close(solution.at.phi, 0, 1e-12)


def test_sigma_solves_for_a_level_set_w(pair: Pair) -> None:
    """phi = w is the same linkage with its right base moved by w."""
    mechanism, reference = pair
    w = np.array([0.01, -0.006])
    for q in mechanism.q_tree[Q] + np.random.default_rng(3).uniform(-0.5, 0.5, (50, 2)):
        solution = sigma(mechanism, q, w=w)
        assert solution.verdict == "converged"
        assert_close(reference.phi(solution.at.q_tree), w, 1e-12)
        assert reference.s(solution.at.q_tree) > 0


def test_sigma_follows_from_level_to_level(pair: Pair) -> None:
    """From phi = 0 to a base moved by nine tenths of what the links bear, and back, at one q and at another."""
    mechanism, reference = pair
    q = mechanism.q_tree[Q] + [0.3, -0.2]
    away = -0.9 * (reference.l[1] + reference.l[3] - elbow_distance(reference, q))
    w = np.array([-away, 0.0])
    moved = replace(reference, base=reference.base - away)
    for dq in ([0.0, 0.0], [-0.05, 0.02]):
        start = sigma(mechanism, q).at
        there = follow_sigma(start, np.array(dq), w, mechanism.tolerance, anywhere=False)
        assert there.verdict == "converged"
        assert_close(turned(there.at.q_tree - moved.sigma(q + dq)), 0, 1e-11)
        back = follow_sigma(there.at, -np.array(dq), 0.0, mechanism.tolerance, anywhere=False)
        assert back.verdict == "converged"
        assert_close(turned(back.at.q_tree - reference.sigma(q)), 0, 1e-11)


def test_sigma_from_the_other_branch_stays_there(pair: Pair) -> None:
    mechanism, reference = pair
    start = mechanism.kinematics(reference.sigma(mechanism.q_tree[Q], branch=-1))
    for q in mechanism.q_tree[Q] + np.random.default_rng(4).uniform(-0.5, 0.5, (50, 2)):
        solution = sigma(mechanism, q, start)
        assert solution.verdict == "converged"
        assert_close(turned(solution.at.q_tree - reference.sigma(q, branch=-1)), 0, 1e-11)


def test_sigma_out_of_reach_reports_the_miss(pair: Pair) -> None:
    """Beyond l2 + l4 the nearest miss of the tips is what the distal links are too short by."""
    mechanism, reference = pair
    reach, seen = reference.l[1] + reference.l[3], 0
    for q in random_q(5, 60):
        gap = elbow_distance(reference, q) - reach
        if gap > 1e-3:
            solution = sigma(mechanism, q)
            seen += 1
            assert solution.verdict == "out of reach"
            assert 0 < solution.reached < 1
            assert_close(solution.at.phi, 0, mechanism.tolerance)
            assert gap / np.sqrt(2) * (1 - 1e-6) <= solution.miss <= gap * (1 + 1e-6)
            with pytest.raises(ValueError, match="out of reach"):
                reference.sigma(q)
    assert seen > 10


@pytest.mark.parametrize("inside", [1e-2, 1e-4, 1e-6, 1e-8])
def test_sigma_converges_close_to_the_outer_singularity(pair: Pair, inside: float) -> None:
    """Type 2: links 2 and 4 all but in line; z is then as the square root of the distance, and sigma finds it."""
    mechanism, reference = pair
    q = q_near_type_2(pair, inside)
    solution = sigma(mechanism, q)
    assert solution.verdict == "converged"
    closed = reference.sigma(q)
    assert_close(turned(solution.at.q_tree - closed), 0, 1e-12 / abs(reference.s(closed)))


@pytest.mark.parametrize("outside", [1e-3, 1e-5, 1e-7])
def test_sigma_just_outside_the_workspace_is_out_of_reach(pair: Pair, outside: float) -> None:
    mechanism, _ = pair
    assert sigma(mechanism, q_near_type_2(pair, -outside)).verdict == "out of reach"


def test_coincident_elbows_are_singular(five_bar: Pair) -> None:
    """Type 1, at (theta_1, theta_3) = +-(0.993865, 2.147728): any z closes the loop, phi_z has lost rank."""
    mechanism, reference = five_bar
    for sign in (1, -1):
        q = sign * coincident_elbows(reference)
        assert_close(q, sign * TYPE_1, 5.1e-7)
        assert sigma(mechanism, q).verdict == "singular"


def test_elbows_of_unequal_links_cannot_coincide(pair: Pair) -> None:
    """Erratum 3: with |l2 - l4| = 0.0254 the same q is out of reach."""
    mechanism, reference = pair
    if reference.l[1] != reference.l[3]:
        assert sigma(mechanism, coincident_elbows(reference)).verdict == "out of reach"


def q_near_type_2(pair: Pair, inside: float) -> Array:
    """q on the way outwards from the equilibrium, whose elbows are `inside` metres nearer than l2 + l4."""
    mechanism, reference = pair
    start, direction = mechanism.q_tree[Q], np.array([-1.0, 1.0])
    inner, outer = 0.0, 1.5
    for _ in range(100):
        middle = (inner + outer) / 2
        too_far = elbow_distance(reference, start + middle * direction) > reference.l[1] + reference.l[3] - inside
        inner, outer = (inner, middle) if too_far else (middle, outer)
    return start + inner * direction


def coincident_elbows(reference: FiveBar) -> Array:
    """Apex of the triangle over the base whose sides are the proximal links."""
    l1, l3, base = reference.l[0], reference.l[2], reference.base
    cosine = (l1**2 + base**2 - l3**2) / (2 * l1 * base)
    apex = l1 * np.exp(1j * np.arccos(cosine))
    return np.angle([apex, apex - base])


def test_loops_without_redundant_rows_are_closed_to_the_tolerance_and_no_further(pair: Pair) -> None:
    """Rounding is for rows that contradict each other: what z leaves open here is the caller's choice."""
    mechanism, by_hand = pair
    stale = np.array(by_hand.equilibrium())
    stale[Q] += [0.01, 0.005]
    open_by = np.abs(by_hand.phi(stale)).max()
    for tolerance in (2 * open_by, 0.5 * open_by):
        solution = newton(mechanism.kinematics(stale), 0.0, tolerance)
        assert solution.converged
        assert solution.iterations == (0 if open_by <= tolerance else 1)
        assert 1e-8 < np.abs(by_hand.phi(solution.at.q_tree)).max() <= tolerance


PARALLELOGRAM = """<robot name="parallelogram"><link name="base"/>
  {links}
  <joint name="left" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="continuous"><parent link="a"/><child link="b"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="right" type="continuous"><parent link="base"/><child link="c"/><origin xyz="0.3 0 0"/>
    <axis xyz="0 0 1"/></joint></robot>"""
LINK = """<link name="{}"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.mark.parametrize(("loop", "rows"), [("point_2d", 2), ("hinge", 5)])
def test_a_path_ends_at_a_flat_parallelogram_with_redundant_rows_too(loop: str, rows: int) -> None:
    """Both cranks turn by the same angle; det phi_z is proportional to its sine and changes its sign at zero."""
    mechanism = Mechanism.from_urdf(
        PARALLELOGRAM.format(links="".join(map(LINK.format, "abc"))),
        loops=[{"name": "pin", "type": loop, "frame_a": {"link": "b", "xyz": [0.3, 0, 0]},
                "frame_b": {"link": "c", "xyz": [0.1, 0, 0]}}],
        q_guess={"left": 1.0, "elbow": -1.0, "right": 1.0},
        independent=["left"],
    )  # fmt: skip
    assert mechanism.assembled.phi_z.shape == (rows, 2)
    for angle in (0.5, 1e-3, 2.9):
        assert_close(sigma(mechanism, np.array([angle])).at.q_tree, [angle, -angle, angle], 1e-9)
    for angle, flat, fraction in ((-0.4, 0.0, 1.0 / 1.4), (3.5, np.pi, (np.pi - 1.0) / 2.5)):
        solution = sigma(mechanism, np.array([angle]), anywhere=False)
        assert solution.verdict == "singular"
        assert solution.reached == pytest.approx(fraction, abs=1e-6)
        assert_close(solution.at.q_tree, [flat, -flat, flat], 1e-6)
