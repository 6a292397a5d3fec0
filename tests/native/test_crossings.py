"""Where J nearly or really loses rank, in the native core: as Python leaps, and with no step of Python's for it."""

import subprocess
import sys

import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.simulation.burst import Burst
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.record import Recorder
from ckc_pin.simulation.scene import load_scene
from tests.regression.test_reference_cases import first_top_pin

T_END = 3.0  # with three positions where the rods lie flat


def _row_of_squares(N, rtol, **changes):
    scene = {"mechanism.N": N, "t_end": T_END, "solver.output_dt": 0.1, "solver.rtol": rtol}
    return simulate("n_four_bar", {**scene, **{key.replace("__", "."): value for key, value in changes.items()}})


@pytest.fixture
def steps_of_python(monkeypatch):
    """Times at which Python was asked for a step."""
    found, step = [], RankGuard.step

    def told(guard):
        found.append(guard.stepper.t)
        return step(guard)

    monkeypatch.setattr(RankGuard, "step", told)
    return found


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-7), (2, 1e-9), (5, 1e-11), (20, 1e-8)])
def test_crossings_are_leapt_over_without_python(N, rtol, steps_of_python):
    run = _row_of_squares(N, rtol)
    assert run.status == "done", run.message
    assert steps_of_python == []
    wanted = [first_top_pin(N, t) for t in run.t]
    assert np.abs(run.points["B0"][:, :2] - wanted).max() < 200 * rtol


def test_a_coarse_run_asks_python_once_and_is_made_again_to_the_first_crossing(steps_of_python):
    run = _row_of_squares(3, 1e-4)
    assert run.status == "done", run.message
    assert len(steps_of_python) == 1
    wanted = [first_top_pin(3, t) for t in run.t]
    after = run.t > 0.75  # the first is at 0.6 s; before it the output is as coarse as it was asked for
    assert np.abs(run.points["B0"][:, :2] - wanted)[after].max() < 1e-5


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-8), (4, 1e-10)])
def test_both_backends_come_out_the_same(N, rtol):
    python, native = (_row_of_squares(N, rtol, solver__backend=backend) for backend in ("python", "native"))
    assert python.status == native.status == "done"
    assert np.abs(native.q_tree - python.q_tree).max() < 500 * rtol
    assert native.stats["rhs"] < 1.1 * python.stats["rhs"]
    assert native.max_phi < 1e-11


def test_a_budget_ends_a_run_with_crossings_where_it_is_used_up():
    whole = _row_of_squares(2, 1e-8)
    cut = _row_of_squares(2, 1e-8, solver__max_rhs=whole.stats["rhs"] - 50)
    assert cut.status == "stopped"
    assert "max_rhs" in cut.message
    assert cut.stats["rhs"] <= whole.stats["rhs"] - 50
    assert 0.5 * T_END < cut.t[-1] < T_END


@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-10])
def test_positions_that_only_come_near_cost_no_step_of_python(rtol, steps_of_python):
    """Two arms on a bar come near a loss of rank several times in two seconds; the reference is Python's own run."""
    changes = {"t_end": 0.8, "solver.rtol": rtol, "solver.output_dt": 0.1}
    native = simulate("two_ur5", changes)
    assert native.status == "done", native.message
    assert steps_of_python == []
    python = simulate("two_ur5", {**changes, "solver.backend": "python", "solver.rtol": min(rtol, 1e-9)})
    assert np.abs(native.q_tree - python.q_tree).max() < 1e3 * rtol


def test_a_method_of_python_s_is_left_to_python_on_the_way_back_to_a_crossing():
    """ "auto" may have changed to it since the run began."""
    scene = load_scene("n_four_bar", {"solver.method": "Radau"})
    ready = prepare(scene)
    stepper = Stepper(ready.system, ready.method, scene.spec.solver, 1.0)
    recorder = Recorder(ready.system, ready.plant.effort, None)
    Burst(stepper, RankGuard(stepper), recorder, np.zeros(0), lambda until, end: until).unrecorded()
    assert (stepper.t, stepper.steps, stepper.solver.status) == (0.0, 0, "running")


def test_nothing_of_the_native_core_is_left_when_python_ends():
    """Kept alive by a module of the caller's, which is what the report's libraries do."""
    program = (
        "import ctypes, ckc_pin, ckc_pin.simulation.burst as burst\n"
        "ckc_pin.simulate('n_four_bar', {'t_end': 0.8})\n"
        "ctypes.pythonapi.Py_IncRef(ctypes.py_object(burst._dop853))\n"
        "ctypes.pythonapi.Py_IncRef(ctypes.py_object(burst._leap))\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stderr == ""


@pytest.mark.parametrize("N", [3, 9, 30, 120])
def test_the_least_singular_value_that_is_watched_is_that_of_j(N):
    """Of chains whose J is decomposed whole and of longer ones, against NumPy's and differences of NumPy's."""
    scene = load_scene("n_four_bar", {"mechanism.N": N})
    ready = prepare(scene)
    system, mechanism = ready.system, ready.mechanism
    stepper = Stepper(system, ready.method, scene.spec.solver, 1.0)
    guard = RankGuard(stepper)
    loop = Burst(stepper, guard, Recorder(system, ready.plant.effort, None), np.zeros(0), lambda a, b: a)._loop()
    rows, columns = guard.scales

    def singular_values(t):
        J = mechanism.kinematics(start + t * v_tree).J
        return np.linalg.svd(rows[:, None] * J * columns, compute_uv=False)

    rng = np.random.default_rng(N)
    for _ in range(5):  # off the closure, where the loops are as different as can be
        start, v_tree = rng.uniform(-3, 3, mechanism.n), rng.normal(size=mechanism.n)
        value, rate = loop.rank(np.concatenate([start, v_tree]))
        values, h = singular_values(0.0), 1e-6
        slope = (singular_values(h)[-1] - singular_values(-h)[-1]) / (2 * h)
        assert value == pytest.approx(values[-1] / values[0], rel=1e-3)
        assert rate == pytest.approx(slope / values[0], rel=1e-2)
