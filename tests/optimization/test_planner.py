"""Optimal control that is solved again from new states: closed forms, the Riccati equation, and wrong input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, NumericalError, Planner, Simulator, optimize
from ckc_pin.base.arrays import Array
from tests.optimization.small_models import MASS, slider

TO = {"q": {"theta_1": -1.0, "theta_3": -1.9}}
START = {"theta_1": -1.434, "theta_3": -1.707}


def first_gain(weight: float, horizon: float) -> Array:
    """Return the gain at the start of the finite-horizon regulator of a mass, by the Riccati equation."""
    A, B, Q = np.array([[0, 1], [0, 0.0]]), np.array([[0], [1 / MASS]]), np.diag([1.0, 0.0])

    def rate(t: float, p: Array) -> Array:
        P = p.reshape(2, 2)
        return np.asarray((A.T @ P + P @ A - P @ B @ B.T @ P / weight + Q).ravel())

    P = solve_ivp(rate, (0, horizon), np.zeros(4), rtol=1e-10, atol=1e-12).y[:, -1].reshape(2, 2)
    return np.asarray((B.T @ P / weight)[0])


def test_first_torque_is_that_of_the_riccati_equation() -> None:
    weight, horizon = 1e-2, 1.0
    planner = Planner(slider(), horizon=horizon, minimize={"tracking": 1.0, "effort": weight},
                      desired={"rail": {"offset": 0.0}}, intervals=60)  # fmt: skip
    gain = first_gain(weight, horizon)
    for t, (x, v) in enumerate([(0.5, 0.0), (0.1, -0.7), (-0.3, 1.0)]):
        plan = planner.solve({"t": 0.1 * t, "q": {"rail": x}, "q_dot": {"rail": v}})
        assert plan.tau(0.1 * t)[0] == pytest.approx(-gain @ [x, v], rel=1e-3)


def test_desired_motion_is_over_the_time_of_the_states() -> None:
    """A table that moves with constant rate is followed without any force, and held after its end."""
    table = {"t": [0.0, 2.0], "rail": [0.0, 1.0]}
    planner = Planner(slider(), horizon=0.5, minimize={"tracking": 1.0, "effort": 1e-3},
                      desired={"file": table, "interpolation": "linear"})  # fmt: skip
    plan = planner.solve({"t": 1.0, "q": {"rail": 0.5}, "q_dot": {"rail": 0.5}})
    assert np.abs(plan.torque).max() < 1e-5
    assert np.abs(planner.solve({"t": 3.0, "q": {"rail": 1.0}}).torque).max() < 1e-5


def test_a_shorter_remaining_motion_is_the_rest_of_the_optimum() -> None:
    """Fastest motion of a mass: seen from later states of itself, the end does not move."""
    distance, force = 0.7, 3.0
    planner = Planner(slider(), to={"q": {"rail": distance}}, limits={"torque": force}, intervals=100)
    duration = 2 * np.sqrt(distance * MASS / force)
    for t in (0.0, 0.1, 0.2, 0.3):
        state = {"t": t, "q": {"rail": force / MASS * t**2 / 2}, "q_dot": {"rail": force / MASS * t}}
        assert planner.solve(state).t_end == pytest.approx(duration, rel=2e-4)


def test_first_solution_is_that_of_optimize() -> None:
    planner = Planner("five_bar", horizon=0.5, to=TO, minimize={"effort": 1.0}, limits={"torque": 2.0}, intervals=40)
    plan = planner.solve({"q": START})
    whole = optimize("five_bar", start={"q": START}, to=TO, minimize={"effort": 1.0},
                     limits={"torque": 2.0, "time": 0.5})  # fmt: skip
    assert plan.cost == pytest.approx(whole.cost, rel=1e-6)
    assert (plan.t_start, plan.t_end) == (0.0, 0.5)


def test_replanning_from_disturbed_states_reaches_the_target() -> None:
    """Torques are disturbed at first. Later plans hold the arms at the target, where each of them ends."""
    desired = {name: {"offset": value} for name, value in TO["q"].items()}
    planner = Planner("five_bar", horizon=0.25, to=TO, minimize={"tracking": 1.0, "effort": 1e-4}, desired=desired,
                      limits={"torque": 3.0})  # fmt: skip
    simulator = Simulator("five_bar/swing", {"initial": {"at": "equilibrium"}})
    random, iterations = np.random.default_rng(0), []
    for k in range(60):
        plan = planner.solve(simulator.state)
        iterations.append(plan.iterations)
        tau = plan.tau(simulator.state.t + 0.01) + (random.normal(size=2) * 0.2 if k < 30 else 0.0)
        simulator.step(tau=dict(zip(START, tau.tolist(), strict=True)), dt=0.02)
    assert np.abs(simulator.state.q - [-1.0, -1.9]).max() < 0.01
    assert np.median(iterations[1:]) <= 15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": -1.0}, "Planner: horizon: expected a positive number of seconds, got -1"),
        ({"limits": {"time": 1.0}}, "Planner: limits.time: the duration is horizon"),
        ({"horizon": None, "to": None}, "Planner: without a horizon, motions need an end; give to"),
        ({"horizon": None}, "Planner: without a horizon, minimize needs a weight of time"),
        ({"limits": {"torqe": 1.0}}, "torqe"),
        ({"desired": {"point": "tip", "circle": {}}, "minimize": {"tracking": 1.0}},
         "Planner: desired: paths of points are not supported"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"horizon": 0.5, "to": TO, "minimize": {"effort": 1.0}, **change}
    with pytest.raises(InputError) as error:
        Planner("five_bar", **arguments)
    assert message in str(error.value)


def test_dry_friction_is_refused() -> None:
    with pytest.raises(InputError, match="Planner: dry friction is not supported"):
        Planner(slider(friction=0.5), horizon=1.0, minimize={"effort": 1.0})


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (3.0, "Planner.solve: state: expected a State"),
        ({"q_dot": {}}, "Planner.solve: state: 'q' is missing"),
        ({"q": START, "speed": 1.0}, "Planner.solve: state: unknown key 'speed'"),
        ({"q": {"theta_1": -1.0}}, "theta_3"),
        ({"q": {"theta_1": 3.1, "theta_3": 0.0}}, "Planner.solve: state: the loops do not close at q"),
    ],
)
def test_wrong_states_are_explained(state: Any, message: str) -> None:
    planner = Planner("five_bar", horizon=0.5, to=TO, minimize={"effort": 1.0})
    with pytest.raises(InputError) as error:
        planner.solve(state)
    assert message in str(error.value)


def test_a_state_without_a_solution_ends_with_a_reason_and_the_next_one_is_solved() -> None:
    planner = Planner(slider(), horizon=0.5, to={"q": {"rail": 0.0}}, minimize={"effort": 1.0}, limits={"torque": 3.0})
    with pytest.raises(NumericalError, match=r"(infeasible|stuck|budget): .* largest violation"):
        planner.solve({"q": {"rail": 5.0}})
    assert planner.solve({"q": {"rail": 0.01}}).cost == pytest.approx(12 * (MASS * 0.01) ** 2 / 0.5**3, rel=1e-4)
