"""Losses of rank of J: the monitor of the smallest singular value, and collocation steps across them."""

import subprocess
import sys

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.mechanism.rank import jacobian_scales
from tests.native.loops import start_loop
from tests.regression.test_reference_cases import first_top_pin

T_END = 3.0  # s: the rods lie flat three times

RANK_LOST = 1e-5  # singular value, relative to the root mean square, below which the monitor takes rank as lost


def _row_of_squares(N, rtol, **overrides):
    scene = {"mechanism.N": N, "t_end": T_END, "solver.output_dt": 0.1, "solver.rtol": rtol}
    return simulate("n_four_bar", {**scene, **overrides})


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-7), (2, 1e-9), (5, 1e-11), (20, 1e-8)])
def test_run_stays_on_its_branch_at_losses_of_rank(N, rtol):
    run = _row_of_squares(N, rtol)
    assert run.status == "done", run.message
    assert run.max_phi < 1e-11
    expected = [first_top_pin(N, t) for t in run.t]
    assert np.abs(run.points["B0"][:, :2] - expected).max() < 200 * rtol


def test_coarse_run_is_repeated_up_to_the_first_crossing():
    """An error of 1e-4 at the first crossing would make the branches indistinguishable later."""
    run = _row_of_squares(3, 1e-4)
    assert run.status == "done", run.message
    expected = [first_top_pin(3, t) for t in run.t]
    assert np.abs(run.points["B0"][:, :2] - expected).max() < 1e-5


def test_run_with_crossings_stops_at_its_budget():
    complete = _row_of_squares(2, 1e-8)
    limited = _row_of_squares(2, 1e-8, **{"solver.max_rhs": complete.stats["rhs"] - 50})
    assert limited.status == "stopped"
    assert "max_rhs" in limited.message
    assert limited.stats["rhs"] <= complete.stats["rhs"] - 50
    assert 0.5 * T_END < limited.t[-1] < T_END


@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-10])
def test_run_passes_close_to_losses_of_rank(rtol):
    """Two arms on a bar come close to a loss of rank several times. The reduced model does not monitor the rank."""
    overrides = {"t_end": 0.8, "solver.rtol": rtol, "solver.output_dt": 0.1}
    run = simulate("two_ur5", overrides)
    assert run.status == "done", run.message
    reduced = simulate("two_ur5", {**overrides, "formulation": "reduced", "solver.rtol": min(rtol, 1e-9)})
    assert np.abs(run.q_tree - reduced.q_tree).max() < 1e3 * rtol


def test_native_core_leaks_nothing_when_python_exits():
    """A user's module may keep a reference to the core."""
    program = (
        "import ctypes, ckc_pin\n"
        "from ckc_pin.native import _core\n"
        "ckc_pin.simulate('n_four_bar', {'t_end': 0.8})\n"
        "simulator = ckc_pin.Simulator('five_bar/swing')\n"
        "ctypes.pythonapi.Py_IncRef(ctypes.py_object(_core))\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stderr == ""


@pytest.mark.parametrize("N", [1, 3, 9, 30, 120])
def test_monitored_singular_value_is_the_smallest_of_J(N):
    """Value and rate agree with NumPy, for chains whose J is decomposed as a dense matrix and for longer ones.

    The monitor begins with its last vector, which is near the new one along each line and far from it between lines.
    """
    ready = start_loop("n_four_bar", {"mechanism.N": N})
    mechanism = ready.mechanism
    rows, columns = jacobian_scales(mechanism.tree, mechanism.closure)

    def singular_values(q_tree):
        J = mechanism.kinematics(q_tree).J
        return np.linalg.svd(rows[:, None] * J * columns, compute_uv=False)

    rng = np.random.default_rng(N)
    # off the constraint manifold the loops are all different
    lines = [(rng.uniform(-3, 3, mechanism.n), rng.normal(size=mechanism.n)) for _ in range(5)]
    states = [(start + t * v_tree, v_tree, t) for start, v_tree in lines for t in (0.0, 0.03, 0.1, 0.3)]
    ranks = ready.loop.ranks(np.array([np.concatenate(state[:2]) for state in states]))
    for (q_tree, v_tree, t), (value, rate) in zip(states, ranks, strict=True):
        values, h = singular_values(q_tree), 1e-6
        change = singular_values(q_tree + h * v_tree)[-1] - singular_values(q_tree - h * v_tree)[-1]
        slope, mean = change / (2 * h), np.sqrt(np.mean(values**2))
        assert value == pytest.approx(values[-1] / mean, rel=1e-6)
        if t == 0.0 or value > RANK_LOST:  # nearer to a loss of rank, the vectors' error of 1e-7 counts
            assert rate == pytest.approx(slope / mean, rel=1e-2)


@pytest.mark.parametrize("N", [1, 3, 6, 9, 20, 120])
def test_monitor_sees_the_singular_position_itself(N):
    """Where all bars lie on one line, sigma is exactly zero, also right after a regular position."""
    ready = start_loop("n_four_bar", {"mechanism.N": N})
    n, regular = ready.mechanism.n, ready.mechanism.q_tree
    states = [np.concatenate([q_tree, np.ones(n)]) for q_tree in (regular, np.zeros(n), regular)]
    (before, _), (there, _), (after, _) = ready.loop.ranks(np.array(states))
    assert there < 1e-14
    assert after == pytest.approx(before, rel=1e-6)
    assert before > 1e-3
