"""Model-predictive control: closed forms of a double integrator from each new state, a closed loop, and messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, NumericalError, Planner
from tests.optimization.small_models import MASS, slider

TARGET = {"theta_1": -1.0, "theta_3": -1.9}


def state(t: float, x: float, v: float) -> dict[str, Any]:
    return {"t": t, "q": {"rail": x}, "q_dot": {"rail": v}}


def least_effort(x: float, v: float, distance: float, time: float) -> float:
    """Return the smallest integral of squared force that brings a mass from x and v to rest at `distance`."""
    off = x + v * time - distance
    return MASS**2 * (4 * v**2 / time - 12 * v * off / time**2 + 12 * off**2 / time**3)


def test_each_plan_has_the_least_effort_from_its_state() -> None:
    distance, horizon, random = 0.7, 1.5, np.random.default_rng(0)
    planner = Planner(slider(), horizon=horizon, to={"q": {"rail": distance}}, minimize={"effort": 1.0})
    x, v, t = 0.0, 0.0, 0.0
    iterations = []
    for _ in range(6):
        plan = planner.solve(state(t, x, v))
        iterations.append(plan.iterations)
        assert (plan.t_start, plan.t_end) == (t, t + horizon)
        assert plan.cost == pytest.approx(least_effort(x, v, distance, horizon), rel=1e-6)
        values, rates, _ = plan.motion(np.array([0.0, 0.1, horizon]))
        assert values[[0, 2], 0] == pytest.approx([x, distance], abs=1e-8)
        assert rates[[0, 2], 0] == pytest.approx([v, 0.0], abs=1e-8)
        x, v = values[1, 0] + 0.02 * random.normal(), rates[1, 0] + 0.1 * random.normal()
        t += 0.1
    assert max(iterations) <= 10


def test_shortest_time_from_each_state_is_that_of_the_closed_form() -> None:
    """With full thrust, then full braking, from x and a speed towards the target."""
    distance, force = 0.7, 3.0
    planner = Planner(slider(), to={"q": {"rail": distance}}, limits={"torque": force}, intervals=60)
    for t, x, v in ((0.0, 0.0, 0.0), (0.2, 0.03, 0.35), (0.4, 0.14, 0.5)):
        plan = planner.solve(state(t, x, v))
        a = force / MASS
        peak = np.sqrt(v**2 / 2 + a * (distance - x))
        assert plan.t_end - t == pytest.approx((2 * peak - v) / a, rel=1e-3)
        assert abs(plan.tau(t)[0] - force) < 1e-2
        assert np.abs(plan.torque).max() <= force


def test_a_pushed_five_bar_returns_to_its_target() -> None:
    planner = Planner(
        "five_bar", horizon=0.3, minimize={"tracking": 1.0, "effort": 1e-4}, limits={"torque": 2.0},
        desired={name: {"offset": x} for name, x in TARGET.items()},
    )  # fmt: skip
    hand = {"name": "hand", "frame": "tip_left", "force": [0, 0, 0]}
    plant = ckc_pin.Simulator("five_bar/swing", {"force": [hand], "initial": {"at": "equilibrium"}})
    errors = []
    for step in range(30):
        plan = planner.solve(plant.state)
        push = [10.0 if step in (12, 13) else 0.0, 0.0, 0.0]
        for part in range(4):
            plant.step(tau=plan.tau(plan.t_start + 0.005 * (part + 0.5)), dt=0.005, wrenches={"hand": push})
        errors.append(np.abs(plant.state.q - np.array(list(TARGET.values()))).max())
    assert errors[11] < 0.02 < 0.06 < errors[14]
    assert errors[-1] < 0.03


def test_plans_follow_a_moving_target() -> None:
    """With tracking alone and no limits, the plan is the desired motion wherever it is consistent with the start."""
    desired = {"rail": {"harmonics": [[0.2, 3.0, 0.0]]}}
    planner = Planner(slider(), horizon=0.5, minimize={"tracking": 1.0}, limits={"torque": 50.0}, desired=desired)
    for t in (0.0, 0.3, 0.7):
        plan = planner.solve(state(t, 0.2 * np.sin(3 * t), 0.6 * np.cos(3 * t)))
        times = np.linspace(0, 0.4, 9)  # the last torques hardly change the cost
        assert plan.motion(times)[0][:, 0] == pytest.approx(0.2 * np.sin(3 * (t + times)), abs=1e-4)
        assert plan.parts["tracking"] < 1e-7


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "without a horizon, motions need an end"),
        ({"horizon": -1.0}, "horizon: expected a positive number of seconds, got -1.0"),
        ({"horizon": 0.5, "limits": {"time": 1.0}}, "limits.time: the duration is horizon"),
        ({"to": {"q": {"rail": 1.0}}, "minimize": {"effort": 1.0}}, "minimize needs a weight of time"),
        ({"horizon": 0.5, "minimize": {"tracking": 1.0}}, "desired"),
    ],
)
def test_bad_arguments_have_one_message(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Planner(slider(torque_limit=1.0), **arguments)


def test_bad_states_and_impossible_ends_have_one_message() -> None:
    planner = Planner(slider(torque_limit=1.0), horizon=0.1, to={"q": {"rail": 1.0}}, minimize={"effort": 1.0})
    with pytest.raises(InputError, match=r"Planner.solve: state: expected a State, or a table with t, q and q_dot"):
        planner.solve({"x": 1.0})
    with pytest.raises(InputError, match=r"Planner.solve: state.q: .*ral"):
        planner.solve({"q": {"ral": 1.0}})
    with pytest.raises(NumericalError, match=r"infeasible|stuck|budget"):
        planner.solve(state(0.0, 0.0, 0.0))


def test_dry_friction_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="dry friction is not supported"):
        Planner(slider(friction=0.1), horizon=1.0, to={"q": {"rail": 1.0}}, minimize={"effort": 1.0})
