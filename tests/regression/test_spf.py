"""The SPF off its manifold: eq. 8 as printed, the coordinates of eq. 17, and the velocity in C."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ckc_pin import Run
from tests.analytic.five_bar import FIVE_BAR, Q
from tests.conftest import assert_close

W = [0.01, -0.006]
starts = pytest.mark.parametrize("w", [[0.0, 0.0], W], ids=["on", "off"])
epsilons = pytest.mark.parametrize("epsilon", [1e-2, 1e-3])


def eq_8(run: Callable[..., Run], epsilon: float, w: list[float]) -> Run:
    return run("five_bar/swing", formulation="spf", epsilon=epsilon, initial__w=w, t_end=0.5, spf_coordinates="z")


def eq_17(run: Callable[..., Run], epsilon: float, w: list[float]) -> Run:
    return run("five_bar/swing", formulation="spf", epsilon=epsilon, initial__w=w, t_end=0.5, solver__rtol=1e-10)


@starts
@epsilons
def test_eq_8_as_printed_agrees_with_eq_17(run: Callable[..., Run], epsilon: float, w: list[float]) -> None:
    """Rates agree too, because z_dot uses the exact w; the error of phi would be divided by epsilon."""
    printed, levels = eq_8(run, epsilon, w), eq_17(run, epsilon, w)
    assert printed.stats["method"] == "Radau"
    assert printed.stats["newton"] == 0  # z is integrated, so sigma is never evaluated
    assert_close(printed.q_tree, levels.q_tree, 1e-8)
    assert_close(printed.v_tree, levels.v_tree, 1e-7)


@starts
def test_eq_8_as_printed_works_for_any_epsilon(run: Callable[..., Run], w: list[float]) -> None:
    """The number of right-hand sides is bounded even if epsilon amplifies rounding, and outputs are as accurate."""
    counts = []
    for epsilon in (1e-4, 1e-8, 1e-12):
        common = {"formulation": "spf", "epsilon": epsilon, "initial__w": w, "t_end": 0.5}
        printed = run("five_bar/swing", **common, spf_coordinates="z")
        levels = run("five_bar/swing", **common, solver__rtol=1e-10)
        counts.append(printed.stats["rhs"])
        assert printed.status == "done"
        assert printed.max_phi <= 1e-8
        assert_close(printed.q_tree, levels.q_tree, 2e-7)
        assert_close(printed.v_tree[1:], levels.v_tree[1:], 2e-6)  # at the start the rate has the size of w / epsilon
    assert max(counts) <= 1_000


@starts
@epsilons
def test_w_decays_exponentially(run: Callable[..., Run], epsilon: float, w: list[float]) -> None:
    """w(t) = w(0) exp(-t / epsilon), evaluated with the phi of the NumPy five-bar."""
    for ours, tolerance in ((eq_8(run, epsilon, w), 1e-8), (eq_17(run, epsilon, w), 1e-12)):
        decay = np.array(w) * np.exp(-ours.t / epsilon)[:, None]
        assert_close([FIVE_BAR.phi(q) for q in ours.q_tree], decay, tolerance)
        assert_close(ours.w, decay, 1e-13)
        assert ours.max_phi <= tolerance


# Largest error of (q, q_dot) at t = 1 against the DAE, by epsilon: eq. 8 and the closed-form sigma of the numpy
# five-bar, integrated by SciPy's Radau at rtol 1e-10 and DOP853 at 1e-12.
TABLE = [
    ("rho", "rest", {1e-2: 8.5668e-3, 1e-4: 9.1204e-5}),
    ("actual", "rest", {1e-2: 7.3457e-5, 1e-4: 2.7416e-6}),
    ("rho", "moving", {1e-2: 7.3106e-3, 1e-4: 1.8255e-5}),
    ("actual", "moving", {1e-2: 6.7963e-2, 1e-4: 6.9998e-2}),
]


@pytest.mark.parametrize(("convention", "start", "errors"), TABLE)
def test_coriolis_velocity_convention_has_the_expected_error(
    run: Callable[..., Run], convention: str, start: str, errors: dict[float, float]
) -> None:
    """The error is O(epsilon) from rest in both conventions and, from a moving start, with rho q_dot only."""
    q_dot = {"theta_1": 1.0, "theta_3": -2.0} if start == "moving" else {}
    common = {"t_end": 1.0, "solver__rtol": 1e-10, "solver__output_dt": 1.0, "initial__q_dot": q_dot}
    dae = run("five_bar/swing", formulation="dae", **common)
    for epsilon, error in errors.items():
        off = {"epsilon": epsilon, "initial__w": W, "coriolis_velocity": convention}
        spf = run("five_bar/swing", formulation="spf", **off, **common)
        gaps = [np.abs(a[-1, Q] - b[-1, Q]).max() for a, b in ((spf.q_tree, dae.q_tree), (spf.v_tree, dae.v_tree))]
        assert_close(max(gaps), error, 1e-3, relative=True)
