"""Certificate of the gain condition, against closed forms of pendulums and the appendix's five-bar in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.control import SetPoint
from ckc_pin.kinematics.sigma import assembly_branches
from scripts.experiments.certificate.branch_walk import follow
from scripts.experiments.certificate.certificate import certify, level_of, rest_height
from scripts.experiments.tests.set_point_cases import (
    NEAR_START,
    G,
    at_rest,
    five_bar_border,
    five_bar_gradient,
    five_bar_U,
    load_arguments,
    pendulum,
)
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

EDGE = 1e-9


@pytest.mark.parametrize(
    ("K_P", "q", "certified"), [(12.0, -1.0, True), (12.0, 2.5, True), (5.0, 1.0, False), (5.0, 0.2, True)]
)
def test_pendulum_certificate_equals_closed_form(K_P: float, q: float, certified: bool) -> None:
    """With h = g cos q and dh/dq = -g sin q, U and its second derivative have closed forms."""
    mechanism, q_d = pendulum(1), 0.1
    controller = SetPoint(mechanism, np.array([[K_P]]), np.eye(1), np.array([q_d]))

    def U(x: float) -> float:
        return G * (np.sin(x) - np.sin(q_d)) - G * np.cos(q_d) * (x - q_d) + K_P * (x - q_d) ** 2 / 2

    certificate = certify(mechanism, controller, at_rest(mechanism, [q]))
    assert_close(certificate.level, U(q), 1e-12)
    # the interval around q_d, up to where U first passes the level
    ways = [np.arange(0.0, 20.0, 1e-4) * sign for sign in (1, -1)]
    ends = [q_d + x[np.argmax(np.array([U(q_d + y) for y in x]) > U(q) + EDGE)] for x in ways]
    inside = np.linspace(ends[1], ends[0], 100_001)
    smallest_eigenvalue = float(np.min(K_P - G * np.sin(inside)))
    assert (certificate.status == "certified") is certified is (smallest_eigenvalue > 0)
    assert_close(certificate.smallest_eigenvalue, smallest_eigenvalue, 0.02)
    assert not certificate.sampled
    assert certificate.smallest_margin == 1.0
    if not certified:
        fails = float(np.arcsin(K_P / G))  # where the second derivative changes its sign first
        assert_close(certificate.safe_level, U(fails), 0.05 * certificate.level)
        assert "has the eigenvalue" in certificate.reason


def test_three_freedoms_are_marked_as_sampled() -> None:
    mechanism = pendulum(3)
    target = np.array([0.3, 0.1, -0.2])
    stiff = SetPoint(mechanism, 200.0 * np.eye(3), np.eye(3), target)
    certificate = certify(mechanism, stiff, at_rest(mechanism, [0.8, 0.3, 0.0]), divisions=8)
    assert (certificate.status, certificate.sampled) == ("certified", True)
    assert certificate.points > 300
    # |V's second derivative| is at most the sum of the weights' moments
    assert 200 - G * (3 + 2 * 2 + 1 * 3) * 3 < certificate.smallest_eigenvalue < 200
    weak = certify(
        mechanism, SetPoint(mechanism, 60.0 * np.eye(3), np.eye(3), target), at_rest(mechanism, [2.0, 0, 0]), 8
    )
    assert (weak.status, weak.sampled) == ("not certified", True)
    assert weak.smallest_eigenvalue < 0
    upright = SetPoint(mechanism, np.eye(3), np.eye(3), np.array([np.pi / 2, 0, 0]))
    assert "lower at the start" in certify(mechanism, upright, at_rest(mechanism, [-1.0, 0, 0])).reason


def test_five_bar_start_near_target_is_certified() -> None:
    case = load_arguments(NEAR_START)
    certificate = certify(*case, 24)
    assert certificate.status == "certified"
    assert certificate.safe_level == certificate.level
    assert_close(certificate.level, five_bar_U(case.controller, np.array([0.3, 0.5])), 1e-12)
    grid = [
        q
        for x in np.linspace(-0.56, 0.56, 33)
        for y in np.linspace(-0.56, 0.56, 33)
        if five_bar_U(case.controller, q := case.controller.q_d + np.array([x, y])) <= certificate.level
    ]
    eigenvalues = [np.linalg.eigvalsh(case.controller.K_P + five_bar_gradient(q, 1e-3))[0] for q in grid]
    margins = [abs(FIVE_BAR.s(FIVE_BAR.sigma(q))) for q in grid]
    assert min(eigenvalues) - 0.05 < certificate.smallest_eigenvalue < min(eigenvalues) + 1e-3
    assert min(margins) - 0.03 < certificate.smallest_margin < min(margins) + 1e-3


def test_scene_whose_set_reaches_type_2_is_not_certified() -> None:
    case = load_arguments()
    certificate = certify(*case, 24)
    assert certificate.status == "not certified"
    assert "singular" in certificate.reason
    assert np.isnan(certificate.smallest_eigenvalue)
    assert certificate.smallest_margin == 0.0
    fold = five_bar_border(0.02, 4000)  # so close to the fold, U differs little from its value there
    lowest = min(five_bar_U(case.controller, q) for q in fold)
    assert_close(certificate.safe_level, lowest, 0.01, relative=True)


def test_singular_point_between_lattice_points_is_detected() -> None:
    """Type 1 is a point. With large gains no lattice point near it fails, but the local search finds it."""
    gains = {"controller.K_P": 3000.0, "controller.q_d": {"theta_1": 0.9, "theta_3": 1.9}}
    case = load_arguments({**gains, "initial.at": None, "initial.q": {"theta_1": 0.75, "theta_3": 1.65}})
    assert np.hypot(0.9 - 0.993865, 1.9 - 2.147728) < np.hypot(0.15, 0.25)
    certificate = certify(*case, 12)
    assert certificate.status == "not certified"
    assert "near theta_1 = 0.99" in certificate.reason
    assert "theta_3 = 2.14" in certificate.reason


def test_certificate_names_unsatisfied_assumptions() -> None:
    case = load_arguments(NEAR_START)
    mechanism = case.mechanism
    other = next(x for x in assembly_branches(mechanism)[1:])
    there, _ = follow(mechanism, other, np.array([0.3, 0.5]) - mechanism.independent_part(other.q_tree))
    q = mechanism.independent_part(there.q_tree)
    assert_close(q, [0.3, 0.5], 1e-12)
    certificate = certify(mechanism, case.controller, replace(case.start, at=there), 12)
    assert certificate.status == "not certified"
    off = replace(case.start, w=np.array([1e-3, 0.0]))
    assert "off phi = 0" in certify(mechanism, case.controller, off).reason
    model = SetPoint(load("five_bar"), case.controller.K_P, case.controller.K_V, case.controller.q_d)
    assert "another model" in certify(mechanism, model, case.start).reason


def test_rest_height_equals_lyapunov_function_at_rest() -> None:
    case = load_arguments(NEAR_START)
    assert_close(rest_height(case.mechanism, case.controller, case.start.at), level_of(*case), 1e-14)
