"""Numbers of evaluations of runs: regressions of performance without measuring times."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from ckc_pin import Run, simulate
from tests.conftest import assert_close
from tests.regression.counts import COUNTED, RUNS, TOLERANCE, changed, measured, recorded

# right-hand sides, Newton corrections per right-hand side
LIMITS = {
    ("five_bar/swing", "reduced"): (1_500, 1.3),
    ("five_bar/swing", "spf"): (1_500, 1.3),
    ("five_bar/swing", "dae"): (1_750, 0.3),
    ("five_bar/set_point", "reduced"): (1_000, 1.0),
    ("five_bar/set_point", "dae"): (1_150, 0.3),
    ("five_bar/tracking", "reduced"): (1_500, 1.0),
    ("five_bar/tracking", "spf"): (1_500, 1.0),
    ("five_bar/tracking", "dae"): (3_000, 0.3),
}


@pytest.mark.parametrize("name", RUNS)
def test_evaluation_counts_match_the_recorded_ones(name: str) -> None:
    """Counts agree within 2 %; `tests/regression/counts.py` describes how to record new ones."""
    assert changed(measured(name), recorded()[name]) == {}


def test_count_change_above_two_percent_is_detected() -> None:
    for name, recorded_counts in recorded().items():
        assert set(recorded_counts) == set(COUNTED)
        assert changed(recorded_counts, recorded_counts) == {}
        for count, number in recorded_counts.items():
            for count_now in (number - int(0.02 * number), number + int(0.02 * number)):
                assert changed(recorded_counts | {count: count_now}, recorded_counts) == {}
            for count_now in (number - int(0.02 * number) - 1, number + int(0.02 * number) + 1):
                assert changed(recorded_counts | {count: count_now}, recorded_counts) == {count: (count_now, number)}, (
                    name
                )


@pytest.mark.parametrize(("scene", "formulation"), LIMITS)
def test_number_of_evaluations_at_rtol_1e_8_is_bounded(run: Callable[..., Run], scene: str, formulation: str) -> None:
    ours = run(scene, formulation=formulation)
    limit, newton_per_rhs = LIMITS[scene, formulation]
    assert ours.scene["solver"]["rtol"] == 1e-8
    assert ours.stats["rhs"] <= limit
    assert ours.stats["newton"] <= newton_per_rhs * ours.stats["rhs"]


def test_epsilon_does_not_change_the_cost_in_coordinates_of_eq_17(run: Callable[..., Run]) -> None:
    """The stiff part has a closed form, so from a consistent start the cost is the same for every epsilon."""
    counts = {run("five_bar/swing", formulation="spf", epsilon=epsilon).stats["rhs"] for epsilon in (1e-1, 1e-6, 1e-12)}
    assert len(counts) == 1


@pytest.mark.parametrize("scene", ["five_bar/swing", "five_bar/tracking"])
def test_epsilon_hardly_changes_the_cost_off_the_manifold(run: Callable[..., Run], scene: str) -> None:
    """At most 30 % more right-hand sides than the reduced model at equal tolerance, for any epsilon."""
    reduced = run(scene, formulation="reduced").stats["rhs"]
    for epsilon in (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-9, 1e-12):
        off = run(scene, formulation="spf", epsilon=epsilon, initial__w=[0.01, -0.006])
        assert off.status == "done"
        assert off.stats["rhs"] <= 1.3 * reduced
        assert off.stats["newton"] <= 1.5 * off.stats["rhs"]


# The number of right-hand sides hardly depends on it, so these are Newton corrections due to the initial guess of z.
@pytest.mark.parametrize("scene", ["andrews", "delta", "stewart", "talos"])
def test_number_of_newton_corrections_is_bounded(run: Callable[..., Run], scene: str) -> None:
    ours = run(scene, formulation="reduced", t_end=0.05, solver__output_dt=0.005)
    assert ours.stats["newton"] <= 1.6 * ours.stats["rhs"]


@pytest.mark.parametrize(("scene", "rtol", "t_end"), [("andrews/default", 1e-13, 0.05), ("delta/default", 1e-12, 0.6)])
def test_rounding_errors_do_not_reduce_the_step_size(scene: str, rtol: float, t_end: float) -> None:
    """Here the difference between y and its rates is rounding, which shorter steps do not reduce."""
    rhs = {}
    for formulation in ("dae", "reduced"):
        run = simulate(scene, {"formulation": formulation, "solver.rtol": rtol, "t_end": t_end})
        assert run.status == "done"
        rhs[formulation] = run.stats["rhs"]
    assert rhs["reduced"] < 2.5 * rhs["dae"]


def test_large_angles_do_not_reduce_the_step_size() -> None:
    """After 16 turns the rod's angle near zero has a rounding error above 1e-13, which shorter steps do not reduce."""
    overrides = {"t_end": 5.0, "solver.output_dt": 0.5, "solver.method": "DOP853"}
    tight = simulate("slider_crank", {**overrides, "formulation": "reduced", "solver.rtol": 1e-13})
    assert (tight.status, tight.message) == ("done", "reached t_end")
    assert tight.stats["rhs"] <= 20_000
    dae = simulate("slider_crank", {**overrides, "formulation": "dae", "solver.rtol": 1e-13})
    assert_close(tight.q_tree, dae.q_tree, 1e-10)


@pytest.mark.parametrize("scene", ["five_bar/friction", "talos/default"])
def test_auto_costs_no_more_than_the_better_method_with_many_mode_transitions(scene: str) -> None:
    rhs = {}
    for method in ("auto", "DOP853", "Radau"):
        run = simulate(scene, {"solver.method": method})
        assert run.status == "done"
        rhs[method] = run.stats["rhs"]
    assert rhs["auto"] <= (1.0 + TOLERANCE) * min(rhs["DOP853"], rhs["Radau"])


def test_event_location_evaluates_few_terms() -> None:
    """Events of sliding and sticking joints use the state and the last right-hand side."""
    run = simulate("talos/default", profile=True)
    assert len(run.events) > 150
    assert run.profile["D_tree"]["calls"] <= 1.4 * run.stats["rhs"]


def test_uncontrolled_run_evaluates_no_coriolis_matrix() -> None:
    """An acceleration needs D' and the bias, but neither C' nor the matrix rho_dot."""
    profile = simulate("five_bar/swing", {"formulation": "reduced", "t_end": 0.2}, profile=True).profile
    assert "D_tree" in profile
    assert not {"C_tree", "C", "rho_dot", "h_tree"} & set(profile)
