"""Section III's numbers against the numpy five-bar and against eq. 17 itself."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin.dynamics import Terms
from scripts.experiments.paper.printed import Printed
from scripts.experiments.paper.results import appendix_difference, error_law, plant
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR, FiveBar
from tests.conftest import assert_close


@pytest.mark.parametrize(("model", "rows"), [(FIVE_BAR, (1, 2, 4, 3)), (AS_PRINTED, (1, 2, 3, 4))])
def test_printed_terms_equal_appendix_in_numpy(model: FiveBar, rows: tuple[int, int, int, int]) -> None:
    printed, random = Printed(rows), np.random.default_rng(3)
    for _ in range(20):
        q, v = random.uniform(-3, 3, 4), random.uniform(-3, 3, 4)
        assert_close(printed.D_tree(q), model.D_tree(q), 1e-15)
        assert_close(printed.h_tree(q), model.h_tree(q), 1e-14)
        assert_close(printed.C_tree(q, v, power=1) @ v, model.C_tree(q, v) @ v, 1e-15)
        square = printed.C_tree(q, v) - printed.C_tree(q, v, power=1)
        a = model.m[1] * model.l[0] * model.c[1] * np.sin(q[1])
        assert_close(square[0, 1], -a * (v[1] ** 2 - v[1]), 1e-15)


def test_shipped_mechanisms_match_appendix() -> None:
    for name, rows in (("five_bar", (1, 2, 4, 3)), ("five_bar_as_printed", (1, 2, 3, 4))):
        assert max(appendix_difference(name, rows)) < 1e-12
    assert appendix_difference("five_bar", (1, 2, 3, 4))[0] > 1e-2  # the other assignment is another mechanism


def test_plant_scales_masses_and_gravity() -> None:
    heavy, light = FIVE_BAR.heavier(1.2, 1.2), plant(gravity=0.0)
    q, v = np.array([0.2, -0.4, 1.0, 0.3]), np.zeros(4)
    scaled = plant(mass=1.2)
    assert_close(Terms(scaled, scaled.kinematics(q), v).D_tree, heavy.D_tree(q), 1e-15)
    assert_close(Terms(scaled, scaled.kinematics(q), v).h_tree, heavy.h_tree(q), 1e-14)
    assert_close(Terms(light, light.kinematics(q), v).h_tree, 0.0, 1e-15)


def test_tracking_error_is_independent_of_plant_with_exact_model() -> None:
    """By eq. 17 the error decays like e^-t after r has decayed; r adds the integral of e^s r, of order D / K_D."""
    start = FIVE_BAR.equilibrium()[[0, 2]]
    laws = [error_law("", mechanism, rtol=1e-6) for mechanism in (plant(), plant(gravity=0.0), plant(mass=2.0))]
    for law in laws:
        assert_close(law.error, np.exp(-9.5) * start, 1e-2, relative=True)
    assert_close(laws[1].error, laws[0].error, 1e-9)
    assert_close(laws[2].error, laws[0].error, 1e-6)
    assert laws[1].steady_u < 0.2 < laws[0].steady_u < laws[2].steady_u


def test_tracking_error_depends_on_model_error() -> None:
    law = error_law("", plant(mass=1.2), plant(), rtol=1e-6)
    assert np.abs(law.error).min() > 1e-2


def test_default_run_has_published_numbers() -> None:
    law = error_law("", plant())
    assert_close(law.error, [-1.0775e-4, -1.281e-4], 1e-8)
    assert_close(law.steady_u, 1.35, 0.01)
