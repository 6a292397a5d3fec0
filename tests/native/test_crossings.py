"""Where J nearly or really loses rank: the monitor, and collocation steps across."""

import subprocess
import sys

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.mechanism.rank import jacobian_scales
from tests.native.loops import started
from tests.regression.test_reference_cases import first_top_pin

T_END = 3.0  # with three positions where the rods lie flat


def _row_of_squares(N, rtol, **overrides):
    scene = {"mechanism.N": N, "t_end": T_END, "solver.output_dt": 0.1, "solver.rtol": rtol}
    return simulate("n_four_bar", {**scene, **overrides})


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-7), (2, 1e-9), (5, 1e-11), (20, 1e-8)])
def test_crossings_are_passed_on_the_right_branch(N, rtol):
    run = _row_of_squares(N, rtol)
    assert run.status == "done", run.message
    assert run.max_phi < 1e-11
    wanted = [first_top_pin(N, t) for t in run.t]
    assert np.abs(run.points["B0"][:, :2] - wanted).max() < 200 * rtol


def test_a_coarse_run_is_made_again_to_the_first_crossing():
    """With an error of 1e-4 there, the branches could not be told apart later."""
    run = _row_of_squares(3, 1e-4)
    assert run.status == "done", run.message
    wanted = [first_top_pin(3, t) for t in run.t]
    assert np.abs(run.points["B0"][:, :2] - wanted).max() < 1e-5


def test_a_budget_ends_a_run_with_crossings_where_it_is_used_up():
    whole = _row_of_squares(2, 1e-8)
    cut = _row_of_squares(2, 1e-8, **{"solver.max_rhs": whole.stats["rhs"] - 50})
    assert cut.status == "stopped"
    assert "max_rhs" in cut.message
    assert cut.stats["rhs"] <= whole.stats["rhs"] - 50
    assert 0.5 * T_END < cut.t[-1] < T_END


@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-10])
def test_positions_that_only_come_near_are_passed_in_ordinary_steps(rtol):
    """Two arms on a bar come near a loss of rank several times in two seconds; the reduced model watches nothing."""
    overrides = {"t_end": 0.8, "solver.rtol": rtol, "solver.output_dt": 0.1}
    run = simulate("two_ur5", overrides)
    assert run.status == "done", run.message
    reduced = simulate("two_ur5", {**overrides, "formulation": "reduced", "solver.rtol": min(rtol, 1e-9)})
    assert np.abs(run.q_tree - reduced.q_tree).max() < 1e3 * rtol


def test_nothing_of_the_native_core_is_left_when_python_ends():
    """Kept alive by a module of the caller's, which is what the report's libraries do."""
    program = (
        "import ctypes, ckc_pin\n"
        "from ckc_pin.native import _core\n"
        "ckc_pin.simulate('n_four_bar', {'t_end': 0.8})\n"
        "simulator = ckc_pin.Simulator('five_bar/swing')\n"
        "ctypes.pythonapi.Py_IncRef(ctypes.py_object(_core))\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stderr == ""


@pytest.mark.parametrize("N", [3, 9, 30, 120])
def test_the_least_singular_value_that_is_monitored_is_that_of_j(N):
    """Of chains whose J is decomposed whole and of longer ones, against NumPy's and differences of NumPy's."""
    ready = started("n_four_bar", {"mechanism.N": N})
    mechanism = ready.mechanism
    rows, columns = jacobian_scales(mechanism.tree, mechanism.closure)

    def singular_values(t):
        J = mechanism.kinematics(start + t * v_tree).J
        return np.linalg.svd(rows[:, None] * J * columns, compute_uv=False)

    rng = np.random.default_rng(N)
    for _ in range(5):  # off the closure, where the loops are as different as can be
        start, v_tree = rng.uniform(-3, 3, mechanism.n), rng.normal(size=mechanism.n)
        value, rate = ready.loop.rank(np.concatenate([start, v_tree]))
        values, h = singular_values(0.0), 1e-6
        slope, mean = (singular_values(h)[-1] - singular_values(-h)[-1]) / (2 * h), np.sqrt(np.mean(values**2))
        assert value == pytest.approx(values[-1] / mean, rel=1e-6)
        assert rate == pytest.approx(slope / mean, rel=1e-2)
