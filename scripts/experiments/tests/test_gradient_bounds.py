"""Bounds of dh/dq on a branch and along a trajectory, against the appendix's five-bar in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import Mechanism, load
from ckc_pin.control.desired import Harmonics
from ckc_pin.control.spec import MotionSpec
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import assembly_branches, sigma
from ckc_pin.mechanism.configuration import Kinematics
from scripts.experiments.certificate.branch_walk import margin, margin_gradient
from scripts.experiments.certificate.gradient_bounds import (
    Bound,
    bound_along,
    chart_step,
    explore_branch,
    gradient_bounds,
)
from scripts.experiments.tests.set_point_cases import five_bar_border, five_bar_gradient, pendulum
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import Pair, assert_close

DIVISIONS = 28


def bounds_on(mechanism: Mechanism, branch: Kinematics, margins: list[float]) -> list[Bound]:
    explored = explore_branch(mechanism, branch, DIVISIONS)
    return gradient_bounds(mechanism, explored, margins, chart_step(mechanism, DIVISIONS))


@pytest.fixture(scope="module")
def bounds(five_bar: Pair) -> dict[float, Bound]:
    """Bounds on the assembled branch by margin, from one exploration."""
    mechanism, _ = five_bar
    margins = [0.5, 0.1]
    return dict(zip(margins, bounds_on(mechanism, mechanism.assembled, margins), strict=True))


@pytest.mark.parametrize(("s_min", "finer"), [(0.5, 1e-3), (0.1, 1e-4)])
def test_bounds_equal_extremes_on_border(bounds: dict[float, Bound], s_min: float, finer: float) -> None:
    bound = bounds[s_min]
    border = [five_bar_gradient(q, finer) for q in five_bar_border(s_min, 600)]
    assert_close(bound.norm, max(np.linalg.norm(g, 2) for g in border), 1e-3, relative=True)
    assert_close(
        bound.low, min(np.linalg.eigvalsh((g + g.T) / 2)[0] for g in border), 5e-3, relative=True
    )  # the border is sampled
    for q, value in ((bound.norm_q, bound.norm), (bound.low_q, -bound.low)):
        assert abs(FIVE_BAR.s(FIVE_BAR.sigma(q))) >= s_min * (1 - 1e-6)
        assert value <= np.linalg.norm(five_bar_gradient(q, finer), 2) * (1 + 1e-5)


def test_other_branch_has_mirrored_bounds(five_bar: Pair, bounds: dict[float, Bound]) -> None:
    """The mirror image at the base line has gravity upwards, so dh/dq changes its sign."""
    mechanism, _ = five_bar
    _, other = assembly_branches(mechanism)
    (mirrored,), assembled = bounds_on(mechanism, other, [0.5]), bounds[0.5]
    assert_close(mirrored.norm, assembled.norm, 2e-3, relative=True)
    assert_close(mirrored.low, -assembled.norm, 2e-3, relative=True)  # the norm is that of a positive eigenvalue
    assert assembled.low > mirrored.low + 1


def test_bound_along_trajectory_equals_numpy_five_bar(five_bar: Pair) -> None:
    mechanism, _ = five_bar
    waves = [(np.pi / 3, 1.0, 0.0)], [(np.pi / 4, 1.0, -np.pi / 2)]
    desired = Harmonics([MotionSpec(harmonics=waves[0]), MotionSpec(offset=np.pi / 4, harmonics=waves[1])])
    times = np.linspace(0, 2 * np.pi, 100)
    gradients = [five_bar_gradient(desired(t)[0], 1e-3) for t in times]
    bound = bound_along(mechanism, desired, times)
    assert_close(bound.norm, max(np.linalg.norm(g, 2) for g in gradients), 1e-8, relative=True)
    with pytest.raises(InputError, match="leaves the branch"):
        bound_along(load("five_bar_as_printed"), desired, times)


def test_margin_is_sine_between_distal_links(five_bar: Pair) -> None:
    mechanism, numpy_twin = five_bar
    for q in np.random.default_rng(1).uniform(-0.8, 0.8, (10, 2)):
        at = sigma(mechanism, q).at
        assert_close(margin(at), abs(numpy_twin.s(numpy_twin.sigma(q))), 1e-12)
        s = [[abs(numpy_twin.s(numpy_twin.sigma(q + sign * 1e-5 * e))) for sign in (1, -1)] for e in np.eye(2)]
        assert_close(margin_gradient(at), [(a - b) / 2e-5 for a, b in s], 1e-8)
    assert margin(pendulum(2).assembled) == 1.0
