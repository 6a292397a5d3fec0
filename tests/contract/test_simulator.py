"""Simulator steps compared with runs: accuracy, stop reasons, and states."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ckc_pin import InputError, NumericalError, Simulator, Terms, as_ivp, load_scene, simulate
from ckc_pin.run.simulator import State
from tests.conftest import assert_close
from tests.regression.test_reference_cases import first_top_pin

pytestmark = pytest.mark.usefixtures("either_terms")

Array = NDArray[np.float64]
FORMULATIONS = ["reduced", "spf", "dae"]
TIGHT = {"solver.rtol": 1e-10}
NO_FORCE = np.zeros(2)


def assert_same(ours: State, theirs: State, tolerance: float = 0.0) -> None:
    assert ours.t == pytest.approx(theirs.t, abs=1e-12)
    assert_close(ours.q_tree, theirs.q_tree, tolerance)
    assert_close(ours.v_tree, theirs.v_tree, tolerance)


# --- against simulate ----------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_steps_of_a_free_swing_agree_with_the_run(formulation: str) -> None:
    overrides = {**TIGHT, "formulation": formulation, "t_end": 0.5, "solver.output_dt": 0.01}
    run, simulator = simulate("five_bar/swing", overrides), Simulator("five_bar/swing", overrides)
    start = simulator.state.terms.energy
    for k in range(1, len(run.t)):
        state = simulator.step(None if k % 2 else NO_FORCE, 0.01)
        assert state.t == pytest.approx(run.t[k], abs=1e-13)
        assert_close(state.q_tree, run.q_tree[k], 1e-8)
        assert_close(state.v_tree, run.v_tree[k], 1e-7)
        assert_close(state.terms.phi, 0.0, 1e-12)
    assert abs(simulator.state.terms.energy - start) < 1e-9


def test_steps_off_the_manifold_agree_with_the_run() -> None:
    overrides = {
        **TIGHT,
        "formulation": "spf",
        "epsilon": 0.02,
        "initial.w": [0.01, -0.02],
        "t_end": 0.1,
        "solver.output_dt": 0.01,
    }
    for coordinates in ("w", "z"):
        config = {**overrides, "spf_coordinates": coordinates}
        run, simulator = simulate("five_bar/swing", config), Simulator("five_bar/swing", config)
        for k in range(1, 11):
            state = simulator.step(None, 0.01)
            assert_close(state.q_tree, run.q_tree[k], 1e-8)
            assert_close(state.v_tree, run.v_tree[k], 1e-6)
            assert_close(state.w, run.w[k], 1e-12)
            if k == 5:  # also from an intermediate state
                simulator.reset(state)
        assert simulator.state.t == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_steps_with_sampled_u_agree_with_the_run(formulation: str) -> None:
    period = 0.001
    overrides = {**TIGHT, "formulation": formulation, "t_end": 0.05, "solver.output_dt": period}
    run = simulate("five_bar/tracking", {**overrides, "controller.sample_time": period})
    simulator = Simulator("five_bar/tracking", overrides)
    assert simulator.controller is not None
    for k in range(50):
        u = simulator.controller.u(simulator.state.t, simulator.state.terms)
        assert_close(u, run.u[k], 1e-8)
        state = simulator.step(run.u[k], period)
        assert_close(state.q_tree, run.q_tree[k + 1], 1e-8)
        assert_close(state.q, run.q_tree[k + 1][[0, 2]], 1e-8)
        assert_close(state.q_dot, run.v_tree[k + 1][[0, 2]], 1e-7)
    assert np.abs(run.u).max() > 1.0


def _push_on(simulator: Simulator, u: Array | None, steps: int) -> None:
    for _ in range(steps):
        simulator.step(u, 0.01)


class Push:
    """A constant u."""

    def __init__(self, u: Array) -> None:
        self.pushes = u

    def u(self, t: float, terms: Terms) -> Array:
        return self.pushes


@pytest.mark.parametrize("formulation", ["reduced", "spf"])
def test_step_stops_where_simulate_stops(formulation: str) -> None:
    u = np.array([1.0, -1.0])
    overrides = {"formulation": formulation, "t_end": 2.0, "solver.output_dt": 0.01}
    run = simulate("five_bar/swing", overrides, controller=Push(u))
    assert run.status == "stopped"
    assert "singular" in run.message
    simulator = Simulator("five_bar/swing", overrides)
    with pytest.raises(NumericalError, match="singular") as error:
        _push_on(simulator, u, 200)
    assert error.value.t == simulator.state.t
    assert error.value.t == pytest.approx(run.t[-1], abs=2e-3)
    assert_close(simulator.state.terms.phi, 0.0, 1e-12)


@pytest.mark.parametrize("u", [None, NO_FORCE], ids=["None", "zeros"])
def test_steps_cross_rank_loss_like_the_run(u: Array | None) -> None:
    overrides = {
        **TIGHT,
        "formulation": "reduced",
        "t_end": 0.5,
        "initial.q_dot": {"theta_1": 9.0, "theta_3": -9.0},
        "solver.output_dt": 0.02,
    }
    run = simulate("five_bar/swing", overrides)
    assert run.status == "done"
    assert run.stats["switches"] > 0
    simulator = Simulator("five_bar/swing", overrides)
    for k in range(1, len(run.t)):
        state = simulator.step(u, 0.02)
        assert_close(state.q_tree, run.q_tree[k], 1e-6)
        assert_close(state.q, run.q_tree[k][[0, 2]], 1e-6)
    assert_close(state.terms.energy, run.energy[0], 1e-7)
    assert_close(simulator.step(np.ones(2), 1e-3).q, state.q, 0.1)  # in the user's coordinates again


def test_exhausted_budget_raises_numerical_error() -> None:
    simulator = Simulator("five_bar/swing", {"solver.max_rhs": 100, "solver.max_wall_s": 1e-9})
    with pytest.raises(NumericalError, match="max_rhs = 100"):
        _push_on(simulator, None, 20)
    assert 0.02 < simulator.state.t < 0.2
    simulator.reset()
    assert simulator.step(None, 0.01).t == 0.01


def test_step_costs_one_extra_evaluation() -> None:
    """A step with constant u needs one evaluation more than the method."""
    scene = load_scene("five_bar/swing", {"formulation": "reduced"})
    simulator = Simulator(scene)
    for _ in range(3):  # until the method has its step size
        simulator.step(None, 0.002)
    before = simulator.stats["rhs"]
    for _ in range(20):
        simulator.step(None, 0.002)
    assert simulator.stats["rhs"] - before <= 20 * 7
    assert simulator.stats["python_calls"] == 0


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_constant_u_costs_hardly_more_than_the_run(formulation: str) -> None:
    """Steps of the method may be longer than the caller's while u is constant."""
    overrides = {"formulation": formulation, "t_end": 1.0}
    simulator, u = Simulator("five_bar/swing", overrides), np.array([0.05, -0.02])
    for _ in range(1000):
        simulator.step(u, 1e-3)
    assert simulator.stats["rhs"] <= 3 * simulate("five_bar/swing", overrides, controller=Push(u)).stats["rhs"]


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
@pytest.mark.parametrize("dt", [1e-3, 7e-3])
def test_changing_u_agrees_with_scipy(formulation: str, dt: float) -> None:
    """Compared with SciPy on the NumPy equations; steps beyond a change of u are rejected and repeated."""
    u, random = [0.0, 0.0], np.random.default_rng(5)
    simulator = Simulator("five_bar/swing", {"formulation": formulation, "solver.rtol": 1e-9})
    q = simulator.mechanism.partition.q
    problem: Any = as_ivp("five_bar/swing", {"formulation": formulation})

    def force(t: float, terms: Terms) -> Array:
        u_tree = np.zeros(4)
        u_tree[q] = u
        return u_tree

    problem.force, y, t = force, problem.y0, 0.0
    for steps in (1, 1, 2, 13, 3, 40, 1, 7):
        u[:] = random.uniform(-0.5, 0.5, 2)
        for _ in range(steps):
            state = simulator.step(u, dt)
        y = solve_ivp(problem.f, (t, t + steps * dt), y, "DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
        t += steps * dt
        assert state.t == pytest.approx(t, abs=1e-12)
        assert_close(state.q_tree, problem.terms(t, y).q_tree, 1e-7)
        assert_close(state.v_tree, problem.velocity(t, y), 1e-7)


@pytest.mark.parametrize("dt", [2e-3, 0.05])
@pytest.mark.parametrize("varying_u", [False, True])
def test_steps_over_rank_loss_agree_with_the_pendulum(dt: float, varying_u: bool) -> None:
    """A row of parallelograms, flat three times, compared with a pendulum; u is zero, or tiny and changing."""
    simulator, random = Simulator("n_four_bar", {"mechanism.N": 7, "formulation": "dae"}), np.random.default_rng(3)
    for k in range(round(3.0 / dt)):
        if varying_u and k % 20 == 0:
            u = 1e-9 * random.standard_normal(1)
        state = simulator.step(u if varying_u else None, dt)
    place = simulator.mechanism.point_positions(state.terms.q_tree)["B0"]
    assert_close(place[:2], np.array(first_top_pin(7, state.t)), 2e-6)
    if not varying_u:
        plain = simulate("n_four_bar", {"mechanism.N": 7, "formulation": "dae", "t_end": 3.0})
        assert simulator.stats["rhs"] <= 2 * plain.stats["rhs"]


# --- states --------------------------------------------------------------------------------------


def _play(simulator: Simulator, steps: int = 5) -> list[State]:
    return [simulator.step([0.3 * k, -0.2], 0.004) for k in range(steps)]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_reset_restores_exactly(formulation: str) -> None:
    simulator = Simulator("five_bar/swing", {"formulation": formulation})
    start = simulator.state
    first = _play(simulator)
    assert_same(simulator.reset(), start)
    again = _play(simulator)
    for ours, theirs in zip(again, first, strict=True):
        assert_same(ours, theirs)
    middle = first[2]
    assert_same(simulator.reset(middle), middle)
    once = _play(simulator)
    assert_same(simulator.reset(middle), middle)
    for ours, theirs in zip(_play(simulator), once, strict=True):
        assert_same(ours, theirs)
    assert once[-1].t == pytest.approx(0.032, abs=1e-15)
    simulator.reset(middle)
    assert_same(simulator.step([0.9, -0.2], 0.004), first[3], 1e-8)


def test_simulators_are_independent() -> None:
    alone = _play(Simulator("five_bar/swing"))
    one, two = Simulator("five_bar/swing"), Simulator("five_bar/swing", {"formulation": "reduced"})
    for k, expected in enumerate(alone):
        ours = one.step([0.3 * k, -0.2], 0.004)
        two.step([5.0, 5.0], 0.01)
        assert_same(ours, expected)
    before = two.state
    one.reset(before)
    assert_same(one.state, before)
    assert_same(two.state, before)
    assert_same(one.step(None, 0.01), two.step(None, 0.01), 1e-7)


def test_state_does_not_change_with_later_steps() -> None:
    simulator = Simulator("five_bar/swing")
    state = simulator.step(None, 0.05)
    q_tree, v_tree = state.q_tree, state.v_tree.copy()
    simulator.step(np.ones(2), 0.2)
    assert np.array_equal(state.q_tree, q_tree)
    assert np.array_equal(state.v_tree, v_tree)
    assert_close(state.terms.energy, Simulator("five_bar/swing").step(None, 0.05).terms.energy, 0.0)


def test_reset_accepts_an_initial_table() -> None:
    simulator = Simulator("five_bar/swing")
    table = {"q": {"theta_1": np.float64(-1.2), "theta_3": -1.5}, "q_dot": {"theta_3": 0.5}}
    state = simulator.reset(table)
    assert state.t == 0.0
    assert_close(state.q, [-1.2, -1.5], 0.0)
    assert_close(state.q_dot, [0.0, 0.5], 0.0)
    assert_close(state.terms.phi, 0.0, 1e-12)
    run = simulate("five_bar/swing", {"initial": table, "t_end": 0.1})
    assert_close(simulator.step(None, 0.1).q_tree, run.q_tree[-1], 1e-7)
    assert simulator.reset({"at": "equilibrium"}).terms.energy < state.terms.energy


@pytest.mark.parametrize(
    ("state", "says"),
    [
        ({}, "initial: give q"),
        ({"q": {"theta_9": 1.0}}, "no coordinate 'theta_9'|theta_9"),
        ({"q": {"theta_1": 3.1, "theta_3": 0.0}}, "out of reach"),
        ({"w": [0.1, 0.1], "at": "assembled"}, "only the SPF can start off phi = 0"),
        (3, "expected a State or a table"),
    ],
)
def test_invalid_reset_is_rejected_and_keeps_the_state(state: Any, says: str) -> None:
    simulator = Simulator("five_bar/swing")
    before = simulator.step(None, 0.01)
    with pytest.raises(InputError, match=says):
        simulator.reset(state)
    assert_same(simulator.state, before)
    with pytest.raises(InputError, match="reset: the state is of four_bar; this simulator is of five_bar"):
        simulator.reset(Simulator("four_bar").state)


@pytest.mark.parametrize(
    ("u", "dt", "says"),
    [
        (np.zeros(3), 0.01, r"u: expected shape \(2,\) \(theta_1, theta_3\), got \(3,\)"),
        (1.0, 0.01, r"u: expected 2 numbers \(theta_1, theta_3\), got the number 1"),
        ([np.nan, 0.0], 0.01, "u is not finite"),
        ([np.inf, 0.0], 0.01, "u is not finite"),
        (["a", "b"], 0.01, "u: expected a vector of numbers, got"),
        (None, 0.0, "dt = 0.0: expected a number greater than 0"),
        (None, -1, "dt = -1"),
        (None, np.nan, "dt = nan"),
        (None, np.inf, "dt = inf"),
        (None, "1", "dt = '1'"),
        (None, 1e-30, "dt = 1e-30"),
    ],
)
def test_invalid_step_is_rejected_and_keeps_the_state(u: Any, dt: Any, says: str) -> None:
    simulator = Simulator("five_bar/swing")
    before = simulator.step(None, 0.01)
    with pytest.raises(InputError, match=says):
        simulator.step(u, dt)
    assert simulator.state is before


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_copies_are_rejected_with_an_alternative(copied: Callable[[Simulator], Any]) -> None:
    """A copy would share the native loop, so both would step."""
    simulator, other = Simulator("five_bar/swing", TIGHT), Simulator("five_bar/swing", TIGHT)
    _push_on(simulator, np.array([0.1, 0.2]), 10)
    with pytest.raises(InputError, match=r"make another simulator .* other\.reset\(simulator\.state\)"):
        copied(simulator)
    other.reset(simulator.state)
    _push_on(other, np.array([3.0, -3.0]), 3)
    assert simulator.state.t == pytest.approx(0.1)
    other.reset(pickle.loads(pickle.dumps(simulator.state)))
    assert_same(other.step([0.2, 0.1], 0.01), simulator.step([0.2, 0.1], 0.01), 1e-8)


def test_steps_respect_torque_limits() -> None:
    free = Simulator("five_bar/tracking", {"formulation": "reduced"})
    limited = Simulator("five_bar/tracking", {"formulation": "reduced", "controller.torque_limit": 2.0})
    assert_same(limited.step([9.0, -9.0], 0.01), free.step([2.0, -2.0], 0.01), 1e-13)


def test_overrides_of_a_scene_are_those_of_its_name() -> None:
    scene, overrides = load_scene("five_bar/swing"), {"formulation": "dae", "initial.q_dot.theta_1": 0.5}
    states = [Simulator(what, overrides).step(None, 0.01) for what in (scene, "five_bar/swing")]
    np.testing.assert_array_equal(states[0].v_tree, states[1].v_tree)
    assert Simulator(scene).step(None, 0.01).v_tree[0] != states[0].v_tree[0]


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_pauses_of_the_native_loop_do_not_change_any_digit(formulation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def positions(pause: float) -> list[bytes]:
        monkeypatch.setattr("ckc_pin.run.simulator.PAUSE_S", pause)
        simulator = Simulator("five_bar/swing", {"formulation": formulation})
        states = [simulator.step(None, 0.05) for _ in range(12)]
        states += [simulator.step(np.array([0.1, -0.2]), 0.05), *(simulator.step(None, dt) for dt in (0.5, 0.01, 0.3))]
        return [state.q_tree.tobytes() for state in states]

    assert positions(0.0) == positions(60.0)
