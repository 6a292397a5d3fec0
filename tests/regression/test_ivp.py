"""Runs compared with the NumPy reference equations integrated by SciPy at 1e-11, which share no C++."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, as_ivp, load_scene, simulate

TIGHT = 1e-11
SPF = {"formulation": "spf", "initial.w": [0.01, -0.02], "epsilon": 1e-2}
Z = {**SPF, "spf_coordinates": "z"}
DAE, REDUCED = {"formulation": "dae"}, {"formulation": "reduced"}

RUNS = [
    ("andrews/default", {**DAE, "t_end": 0.01}),
    ("andrews/default", {**REDUCED, "t_end": 0.01}),
    ("bricard/default", {"t_end": 1.0}),
    ("delta/circle", {**DAE, "t_end": 0.1}),
    ("delta/circle", {**REDUCED, "t_end": 0.1}),
    ("delta/default", {**DAE, "t_end": 0.2}),
    ("delta/default", {**REDUCED, "t_end": 0.1}),
    ("delta/default", {**SPF, "initial.w": 18 * [1e-3], "t_end": 0.1}),
    ("five_bar/set_point", {**DAE, "t_end": 0.2}),
    ("five_bar/set_point", {**REDUCED, "t_end": 0.5}),
    ("five_bar/set_point", {"t_end": 0.3}),
    ("five_bar/swing", {**DAE, "t_end": 1.0}),
    ("five_bar/swing", {**REDUCED, "t_end": 1.0}),
    ("five_bar/swing", {**SPF, "t_end": 0.3}),
    ("five_bar/swing", {**SPF, "t_end": 0.3, "coriolis_velocity": "actual"}),
    ("five_bar/swing", {**Z, "t_end": 0.3}),
    ("five_bar/swing", {**Z, "t_end": 0.3, "coriolis_velocity": "actual"}),
    ("five_bar/tracking", {**DAE, "t_end": 0.3}),
    ("five_bar/tracking", {**REDUCED, "t_end": 0.3}),
    ("five_bar/tracking", {"t_end": 0.3}),
    ("five_bar/tracking", {**REDUCED, "t_end": 0.1, "controller.torque_limit": 0.3}),
    ("four_bar/turning", {**DAE, "t_end": 0.5}),
    ("four_bar/turning", {**REDUCED, "t_end": 0.5}),
    ("n_four_bar/default", {**DAE, "t_end": 0.3}),
    ("n_four_bar/default", {**REDUCED, "t_end": 0.3}),
    ("stewart/default", {**REDUCED, "t_end": 0.05}),
    ("stewart/wave", {**REDUCED, "t_end": 0.05}),
    ("talos/default", {**DAE, "t_end": 0.02, "friction_smoothing": 0.1}),
    ("three_rrr/circle", {**REDUCED, "t_end": 0.2}),
    ("three_rrr/default", {"t_end": 0.3}),
    ("two_ur5/default", {**DAE, "t_end": 0.2}),
    ("two_ur5/lift", {**REDUCED, "t_end": 0.1}),
]


@pytest.mark.parametrize(("scene", "overrides"), RUNS, ids=str)
def test_run_agrees_with_its_equations_integrated_by_scipy(scene, overrides):
    run = simulate(scene, overrides)
    assert run.status == "done"
    problem = as_ivp(scene, overrides)
    times = run.t[:: len(run.t) // 4]
    method = "Radau" if overrides.get("spf_coordinates") == "z" else "DOP853"
    solution = solve_ivp(problem.f, problem.t_span, problem.y0, method, times, rtol=TIGHT, atol=TIGHT / 100)
    assert solution.success
    for t, y in zip(times, solution.y.T, strict=True):
        row, terms = int(np.searchsorted(run.t, t)), problem.terms(t, y)
        expected = problem.mechanism.tree.to_coordinates(terms.q_tree)
        assert_within_global_error(run.q_tree[row], expected)
        assert_within_global_error(run.v_tree[row], problem.velocity(t, y))
        assert_within_global_error(run.phi[row], terms.phi)


def assert_within_global_error(solution, expected):
    """The global error of a run stays within a hundred times the tolerance of a step."""
    assert np.abs(solution - expected).max() <= 100 * 1e-8 * max(1.0, np.abs(expected).max())


def test_as_ivp_rejects_a_sampled_controller():
    with pytest.raises(InputError, match=r"controller\.sample_time"):
        as_ivp("five_bar/set_point", {"controller.sample_time": 0.01})


def test_overrides_of_a_scene_are_those_of_its_name():
    assert as_ivp(load_scene("five_bar/swing"), {"t_end": 1.0}).t_span == (0.0, 1.0)


def test_rate_is_nan_where_no_state_exists():
    """SciPy's solvers then reduce the step size."""
    problem = as_ivp("five_bar/swing", REDUCED)
    assert np.isnan(problem.f(0.0, problem.y0 + np.array([1e3, 0.0, 0.0, 0.0]))).all()
