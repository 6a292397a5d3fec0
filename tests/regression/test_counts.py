"""What a run may cost, in evaluations: a regression shows here before anybody measures a time."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from ckc_pin import Run, simulate

# right-hand sides, Newton corrections per right-hand side
LIMITS = {
    ("five_bar/swing", "reduced"): (1_500, 2.5),
    ("five_bar/swing", "spf"): (1_500, 2.5),
    ("five_bar/swing", "dae"): (1_750, 0.3),
    ("five_bar/set_point", "reduced"): (4_700, 1.5),
    ("five_bar/set_point", "dae"): (5_200, 0.3),
    ("five_bar/tracking", "reduced"): (6_800, 2.0),
    ("five_bar/tracking", "spf"): (6_800, 2.0),
    ("five_bar/tracking", "dae"): (10_300, 0.3),
}


@pytest.mark.parametrize(("scene", "formulation"), LIMITS)
def test_evaluations_at_rtol_1e_8(run: Callable[..., Run], scene: str, formulation: str) -> None:
    ours = run(scene, formulation=formulation)
    limit, newton_per_rhs = LIMITS[scene, formulation]
    assert ours.scene["solver"]["rtol"] == 1e-8
    assert ours.stats["rhs"] <= limit
    assert ours.stats["newton"] <= newton_per_rhs * ours.stats["rhs"]


def test_epsilon_costs_nothing_in_eq_17s_coordinates(run: Callable[..., Run]) -> None:
    """The stiff part is in closed form: from a consistent start the right-hand sides are the same for every epsilon."""
    counts = {run("five_bar/swing", formulation="spf", epsilon=epsilon).stats["rhs"] for epsilon in (1e-1, 1e-6, 1e-12)}
    assert len(counts) == 1


def test_epsilon_costs_little_off_the_manifold(run: Callable[..., Run]) -> None:
    off = {"formulation": "spf", "initial__w": [0.01, -0.006]}
    counts = [run("five_bar/swing", epsilon=epsilon, **off).stats["rhs"] for epsilon in (1e-1, 1e-3, 1e-6, 1e-12)]
    assert max(counts) <= 1.3 * min(counts)


def test_an_uncontrolled_run_evaluates_no_matrix_C() -> None:
    """An acceleration asks for D' and the bias, never for C', nor for the matrix rho_dot."""
    profile = simulate("five_bar/swing", {"formulation": "reduced", "t_end": 0.2}, profile=True).profile
    assert "D_tree" in profile
    assert not {"C_tree", "C", "rho_dot", "h_tree"} & set(profile)
